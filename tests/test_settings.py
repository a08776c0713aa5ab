"""Settings as records: one check for types, ranges and choices, and one wording."""

import math
from dataclasses import dataclass

import pytest

from stmc.settings.records import SettingError, check, field_infos, record_of, setting


@dataclass(frozen=True)
class Baking:
    steps: int | None = setting(None, "how often to turn", at_least=1)
    heat: float | int = setting(0.5, "of the oven", unit="kW", above=0, below=3)
    kind: str = setting("bread", "what is baked", choices=("bread", "cake"))
    toppings: tuple[str, ...] = setting((), "what lies on it", choices=("salt", "seeds"))
    lid: bool = setting(False, "whether it is covered")

    def __post_init__(self) -> None:
        check(self)


def test_what_fits_is_taken_as_it_is():
    made = record_of(Baking, {"steps": 3, "heat": 1, "kind": "cake", "toppings": ["salt"], "lid": True})
    assert made == Baking(3, 1, "cake", ("salt",), True)
    assert Baking() == record_of(Baking, {})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps": 0}, "steps=0: must be at least 1"),
        ({"steps": "ten"}, "steps='ten': must be a whole number or null, at least 1"),
        ({"steps": 1.5}, "steps=1.5: must be a whole number or null"),
        ({"steps": True}, "steps=true: must be a whole number or null"),
        ({"heat": math.nan}, "heat=nan: must be a number, above 0 and below 3 kW"),
        ({"heat": math.inf}, "heat=inf: must be a number"),
        ({"heat": 3}, "heat=3: must be above 0 and below 3 kW"),
        ({"heat": 10**400}, "heat=an integer of 1329 bits"),
        ({"heat": None}, "heat=null: must be a number"),
        ({"kind": "cak"}, "kind='cak': choose from bread, cake"),
        ({"kind": ["bread"]}, 'kind=["bread"]: must be a text'),
        ({"toppings": ["salt", "sand"]}, "toppings='sand': choose from salt, seeds"),
        ({"lid": 1}, "lid=1: must be true or false"),
        ({"heet": 1}, "unknown setting 'heet': did you mean heat?"),
        ({"kind": "x" * 10_000}, "x…': choose from bread, cake"),
        ({"heat": [[0] * 10_000] * 10_000}, "heat=[[0, 0, 0, 0, 0, 0, 0, 0"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(values, message):
    with pytest.raises(SettingError) as error:
        record_of(Baking, values)
    assert message in str(error.value)
    assert len(str(error.value)) < 300


def test_a_record_tells_what_its_settings_are():
    told = field_infos(Baking)
    assert list(told) == ["steps", "heat", "kind", "toppings", "lid"]
    assert (told["heat"].help, told["heat"].fits) == ("of the oven", "above 0 and below 3 kW")
    assert told["kind"].fits == "one of bread, cake"
