"""Whether a known prompt works: words for side, direction and speed, measured success, warnings and thresholds."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.scripts import ROOT, run
from helpers.studio import studio
from helpers.tiny_model import Hashes, tiny

import stmc
from stmc.data.cache import Cache, Clip
from stmc.data.sources.contents import CONTENTS, describe
from stmc.evaluation.benchmarks.calibrating import (
    calibrate_thresholds,
    rates_of_warnings,
    read_prompts,
    threshold_between,
)
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS
from stmc.motion.body import BodyPart
from stmc.motion.representation import SmplRepresentation
from stmc.run import CALIBRATION, RunError, calibrate
from stmc.settings.records import SettingError
from stmc.text.vocabulary import (
    Calibration,
    Content,
    Recognition,
    Sentence,
    Trial,
    Vocabulary,
    VocabularyError,
    build_vocabulary,
    read_calibration,
    sentence_encoder,
    write_calibration,
)
from stmc.text.vocabulary.agreement import Agreement
from stmc.text.vocabulary.qualifiers import agree, read_qualifiers
from stmc.timeline import PromptWarning, RarelyShownWarning, UnknownPromptWarning

WALK, WAVE = Content("walk", frozenset({BodyPart.LEGS}), True), Content("wave", frozenset({BodyPart.RIGHT_ARM}))
WEIGHTS = {Sentence("walk", WALK): 3.0, Sentence("stroll along", WALK): 2.0, Sentence("wave", WAVE): 1.0}
RARE = Calibration({"walk": Trial("walk", 8, geometry=1.0), "wave": Trial("wave", 8, 0.25, 0.5, 25, 2.5, 3)})


@pytest.fixture(scope="module")
def small() -> Vocabulary:
    """Two actions, compared by hashes of words."""
    return build_vocabulary(WEIGHTS, Hashes())


@pytest.fixture(scope="module")
def one_sided() -> Vocabulary:
    """What a model knows that calls with the left hand, waves with both, jogs forwards and walks both ways."""
    names = ("phone-left", "run", "walk", "walk-back", "walk-slow", "wave-left-hand", "wave-right-hand")
    return build_vocabulary(
        {
            Sentence(text, Content(name, CONTENTS[name].parts, CONTENTS[name].cyclic)): 1.0
            for name in names
            for text in CONTENTS[name].sentences[:30]
        },
        sentence_encoder(),
    )


def qualified(text: str) -> dict[str, set[str]]:
    return {kind: set(values) for kind, values in read_qualifiers(text).items()}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("talk on phone with right hand", {"side": {"right"}}),
        ("wave with Both hands", {"side": {"left", "right"}}),
        ("turn counter-clockwise", {"side": {"left"}}),
        ("turn clockwise", {"side": {"right"}}),
        ("quickly walk backwards", {"direction": {"backward"}, "speed": {"quick"}}),
        ("a slow step sideways", {"direction": {"sideways"}, "speed": {"slow"}}),
        ("jog ahead", {"direction": {"forward"}}),
        ("stand upright right there, all right", {}),
        ("touch the back of the head", {}),
    ],
)
def test_words_for_side_direction_and_speed_are_found(text, found):
    assert qualified(text) == found


@pytest.mark.parametrize(
    ("asked", "known", "agrees"),
    [
        ("kick with the left foot", "kick", False),
        ("kick with the left foot", "left kick", True),
        ("kick with the left foot", "kick with both feet", False),
        ("clap with both hands", "clap", True),
        ("jog forwards", "jog", True),
        ("jog backwards", "jog", False),
        ("walk quickly", "walk", True),
        ("walk quickly", "walk slowly", False),
        ("kick", "kick with the left foot", True),
        ("walk forward, then backward", "walk", True),
    ],
)
def test_a_sentence_agrees_that_names_what_does_not_go_without_saying(asked, known, agrees):
    assert agree(read_qualifiers(asked), read_qualifiers(known)) == agrees


@pytest.mark.parametrize(
    ("known", "unknown"),
    [
        ("talk on phone with left hand", "talk on phone with right hand"),
        ("jogs forwards", "jogs backwards"),
        ("go for a jog", "jog sideways"),
    ],
)
def test_a_known_verb_with_an_unknown_side_or_direction_is_unknown(one_sided, known, unknown):
    inside, outside = one_sided.recognise([known, unknown], sentence_encoder())
    assert inside.known and not outside.known
    assert outside.near and "hardly knows" in outside.advice


def test_where_both_forms_are_known_so_are_prompts_about_either(one_sided):
    texts = ["wave with the left hand", "wave with the right hand", "walk backwards", "walk forwards", "walk slowly"]
    found = one_sided.recognise(texts, sentence_encoder())
    assert [each.text for each in found if not each.known] == []
    names = ["wave-left-hand", "wave-right-hand", "walk-back", "walk", "walk-slow"]
    assert [each.action for each in found] == names


def test_a_text_without_such_words_is_compared_with_all_that_is_known(one_sided):
    encoder, texts = sentence_encoder(), ["talk on the phone", "go for a run", "swim"]
    rows = one_sided.cosines(texts, encoder)
    scores = 2 * rows[:, : len(one_sided.known)].amax(dim=1) - rows[:, len(one_sided.known) :].amax(dim=1)
    found = replace(one_sided, classifier=None).recognise(texts, encoder)
    assert [each.score for each in found] == pytest.approx(scores.tolist(), abs=1e-5)


def test_a_sentence_about_the_other_side_contradicts_unless_its_mirror_image_is_an_action_too():
    texts = {"lift it, left": "raise-left", "raise it, right": "raise-right", "punch, left": "punch-left", "nod": "nod"}
    agreement = Agreement([Sentence(text, Content(name)) for text, name in texts.items()])
    agrees, contradicts = agreement.of("lift it, right")
    assert (agrees.tolist(), contradicts.tolist()) == ([False, True, False, False], [False, False, True, True])
    agrees, contradicts = agreement.of("lift it")
    assert agrees.all() and not contradicts.any()


def test_an_action_s_rate_is_that_of_all_its_samples_and_a_text_s_is_its_own():
    trials = {
        "walk forwards": Trial("walk", 8, geometry=0.25),
        "stroll": Trial("walk", 24, geometry=1.0),
        "amble": Trial("walk", 99, evaluator=0.0),
        "ballet": Trial("ballet", 4, evaluator=0.5),
        "jump": Trial("jump", 4),
    }
    calibration = Calibration(trials)
    assert calibration.rates == {"walk": 26 / 32, "ballet": 0.5}  # geometry's answers alone, where there are some
    assert calibration.rate(" Walk  forwards", "walk") == 0.25
    assert calibration.rate("go", "walk") == 26 / 32 and calibration.rate("jump", "jump") is None
    again = calibration.with_trials({"stroll": Trial("walk", 24, geometry=0.0)})
    assert again.rates["walk"] == 0.0625 and len(again.trials) == len(trials)
    assert calibration.with_trials({"stroll": Trial("walk", 23, geometry=0.0)}) == calibration, (
        "fewer samples tell less"
    )


def test_a_file_gives_back_what_was_written(tmp_path):
    calibration = replace(RARE, threshold=0.5, thresholds={"wave": 0.7}, weights="ab" * 32)
    write_calibration(calibration, tmp_path / CALIBRATION)
    assert read_calibration(tmp_path / CALIBRATION) == calibration
    lines = (tmp_path / CALIBRATION).read_text("utf-8").splitlines()
    assert sum('"wave": {' in line for line in lines) == 1  # a line for each sentence
    write_calibration(Calibration(), tmp_path / CALIBRATION)
    assert read_calibration(tmp_path / CALIBRATION) == Calibration()


CHANGES = {
    "not JSON": lambda table: "{",
    "duplicated": lambda table: '{"trials": {}, "trials": {}}',
    "a calibration: must be an object": lambda table: [],
    "weights=": lambda table: table | {"weights": "abc"},
    "trials: must be an object": lambda table: table | {"trials": []},
    "threshold=": lambda table: table | {"threshold": 9},
    "threshold of 'wave'=": lambda table: table | {"thresholds": {"wave": "low"}},
    "geometry=": lambda table: changed(table, geometry=1.5),
    "evaluator=NaN|evaluator=nan": lambda table: changed(table, evaluator=float("nan")),
    "samples=": lambda table: changed(table, samples=0),
    "steps=.*whole": lambda table: changed(table, steps=2.5),
    "seed=": lambda table: changed(table, seed=True),
    "guidance=": lambda table: changed(table, guidance="much"),
    "'wave': must be an object": lambda table: changed(table, extra=1),
    "printable": lambda table: changed(table, action="wa\u0007ve"),
}


def changed(table: dict, **values: object) -> dict:
    return table | {"trials": {"wave": table["trials"]["wave"] | values}}


@pytest.mark.parametrize("message", CHANGES)
def test_a_file_that_is_none_is_refused_in_a_line(message, tmp_path):
    path = tmp_path / CALIBRATION
    write_calibration(RARE, path)
    table = CHANGES[message](json.loads(path.read_text("utf-8")))
    path.write_text(table if isinstance(table, str) else json.dumps(table))
    with pytest.raises(VocabularyError, match=message) as told:
        read_calibration(path)
    assert "\n" not in str(told.value) and CALIBRATION in str(told.value)


def test_a_calibration_travels_with_its_model_and_not_with_another(small, tmp_path):
    model = replace(tiny(), vocabulary=replace(small, calibration=RARE))
    plain, tuned = (
        stmc.save(replace(tiny(), vocabulary=small), tmp_path / "a", ""),
        stmc.save(model, tmp_path / "b", ""),
    )
    assert not (plain / CALIBRATION).exists() and stmc.load(plain).vocabulary.calibration.is_empty
    found = stmc.load(tuned).vocabulary.calibration
    assert (found.trials, len(found.weights)) == (RARE.trials, 64)
    table = json.loads((tuned / CALIBRATION).read_text("utf-8"))
    (tuned / CALIBRATION).write_text(json.dumps(table | {"weights": "ab" * 32}))
    assert stmc.load(tuned).vocabulary.calibration.is_empty  # measured with other weights
    (tuned / CALIBRATION).write_text("{")
    with pytest.raises(RunError, match=CALIBRATION):
        stmc.load(tuned)
    stmc.save(replace(tiny(), vocabulary=small), tuned, "")
    assert not (tuned / CALIBRATION).exists()


def test_what_was_measured_is_stored_in_a_run_directory_alone(small, tmp_path):
    run_directory = stmc.save(replace(tiny(), vocabulary=small), tmp_path / "run", "")
    assert calibrate(run_directory, RARE) == run_directory / CALIBRATION
    assert stmc.load(run_directory).vocabulary.calibration.trials == RARE.trials
    with pytest.raises(RunError, match="not a run directory"):
        calibrate(tmp_path / "nowhere", RARE)


def test_a_prompt_that_rarely_works_warns_by_a_class_of_its_own_under_the_common_one(small):
    model = replace(tiny(), vocabulary=replace(small, calibration=RARE), text_encoder=Hashes())
    model._recognise._encoder = Hashes()
    timeline = stmc.Timeline.parse("walk # 0 # 0.3\nwave # 0.3 # 0.6\njuggle # 0.6 # 1")
    with pytest.warns(PromptWarning) as told:
        model.generate(timeline, steps=1)
    messages = {each.category: str(each.message) for each in told}
    assert messages[RarelyShownWarning] == "'wave' rarely works: 25 % of samples show it"
    assert "hardly knows 'juggle'" in messages[UnknownPromptWarning] and len(told) == 2
    assert [each.text for each in model.doubtful([timeline])] == ["wave", "juggle"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", PromptWarning)
        model.generate(timeline, steps=1)


def test_a_prompt_that_was_tested_itself_is_known_however_far_it_is_from_the_kept_sentences(small):
    trials = {"Juggle": Trial("juggle", 8, geometry=1.0), "swim": Trial("swim", 8, geometry=0.25)}
    trials["knit"] = Trial("knit", 8)  # sampled, but nobody judged it
    tested = replace(small, calibration=Calibration(trials))
    assert not any(each.known for each in small.recognise(["juggle", "swim"], Hashes()))
    juggle, swim, other, knit = tested.recognise(["juggle ", "swim", "juggle balls", "knit"], Hashes())
    assert juggle.known and juggle.works and not other.known and not knit.known
    assert swim.known and not swim.works and "rarely works: 25 %" in swim.advice


def test_the_studio_says_the_same_sentence(tmp_path):
    known = {Sentence("walk", WALK): 3.0, Sentence("wave the right hand", WAVE): 1.0}
    vocabulary = build_vocabulary(known, sentence_encoder())
    trials = {"wave the right hand": Trial("wave", 8, geometry=0.25)}
    model = replace(tiny(), vocabulary=replace(vocabulary, calibration=Calibration(trials)), text_encoder=Hashes())
    prompts = [{"text": text, "start": 0, "end": 1, "parts": []} for text in ("walk", "wave the right hand", "swim")]
    prompts = [each | {"start": place, "end": place + 1} for place, each in enumerate(prompts)]
    with studio(model, tmp_path) as client:
        walk, wave, swim = client.post("/api/check", json={"timeline": {"prompts": prompts}}).json()["prompts"]
    assert walk["advice"] is None and swim["advice"]["known"] is False
    sentence = "'wave the right hand' rarely works: 25 % of samples show it"
    assert wave["advice"] == {"sentence": sentence, "known": True, "nearest": []}


def scored(text: str, action: str, score: float) -> Recognition:
    sentence = Sentence(action, Content(action))
    return Recognition(text, (sentence,), score, 0.6, (sentence,))


def test_a_threshold_catches_most_unknown_prompts_and_loses_few_known_ones():
    assert threshold_between([0.8, 0.9], [0.1, 0.2]) == 0.5
    known, unknown = [0.3] + [0.9] * 19, [0.5] * 10
    assert threshold_between(known, unknown) == 0.7  # one of twenty may be lost
    assert threshold_between(known[:10], unknown) == 0.3  # one of ten may not
    assert threshold_between([0.5], [0.5]) == 0.5


def test_actions_with_enough_prompts_have_thresholds_of_their_own_and_rare_ones_do_not_count():
    known = {f"walk {number}": "walk" for number in range(8)} | {"wave": "wave", "hop": "hop"}
    unknown = [f"crawl {number}" for number in range(8)] + ["swim"]
    scores = {text: 0.9 for text in known} | {text: 0.8 for text in unknown} | {"swim": 0.1, "wave": -1.0}
    found = {text: scored(text, known.get(text, "walk"), score) for text, score in scores.items()}
    after = calibrate_thresholds(RARE, known, unknown, found)
    assert after.thresholds == {"walk": 0.85} and after.threshold == 0.85 and after.trials == RARE.trials
    assert after.threshold_of("walk", 0.6) == 0.85 and Calibration().threshold_of("walk", 0.6) == 0.6
    before, now = (rates_of_warnings(each, known, unknown, found) for each in (RARE, after))
    assert (before.known, before.unknown, now.known, now.unknown) == (0.0, 1 / 9, 0.0, 1.0)


def test_texts_are_missed_that_neither_work_nor_warn():
    shares = dict(zip(MTT_CHECKS, [1.0, 0.75, 0.5, 0.25, 0.0], strict=False))
    calibration = Calibration({text: Trial(text, 4, geometry=share) for text, share in shares.items()})
    found = {text: replace(scored(text, text, 0.9), rate=share) for text, share in shares.items()}
    rates = rates_of_warnings(calibration, {}, [], found)
    assert (rates.missed, rates.asked, rates.known, rates.unknown) == (1, 5, None, None)
    assert "missed without a warning: 1 of 5" in str(rates)


def test_prompts_are_read_from_our_list_and_no_other_file(tmp_path):
    known, unknown = read_prompts(ROOT / "tests/helpers/prompts.json")
    assert known["go for a walk"] == "walk" and len(known) == 100 and len(unknown) == 160
    for content in ("[]", '{"inside": []}', '{"inside": [1], "outside": []}', '{"inside": [], "outside": [7]}', "{"):
        (tmp_path / "prompts.json").write_text(content)
        with pytest.raises(ValueError, match=r"prompts\.json: "):
            read_prompts(tmp_path / "prompts.json")


@pytest.fixture
def run_directory(tmp_path) -> Path:
    known = {Sentence(text, Content(name, CONTENTS[name].parts)): 1.0
             for name in ("sit", "bow") for text in CONTENTS[name].sentences[:3]}  # fmt: skip
    return stmc.save(replace(tiny(), vocabulary=build_vocabulary(known, sentence_encoder())), tmp_path / "run", "")


@pytest.fixture
def cache(tmp_path) -> Path:
    """Bodies that sit and that stand, which count as a bow."""
    features = SmplRepresentation().encode(*[stand()])[:1].repeat(200, 1)
    clips = tuple(
        Clip(f"{name}{start}", name, "normal", name, ("legs",), False, False, "train", start, start + 50)
        for name, start in (("sit", 0), ("sit", 50), ("bow", 100), ("bow", 150))
    )
    Cache(20, "smpl", features, clips, {name: describe(name, "normal") for name in ("sit", "bow")}).write(
        tmp_path / "cache"
    )
    return tmp_path / "cache"


def stand() -> stmc.Motion:
    return tiny().generate("walk # 0 # 1", steps=1)[0]


@pytest.mark.filterwarnings("ignore::stmc.timeline.PromptWarning")
def test_success_is_stored_by_the_command_and_warned_by(run_directory, cache, tmp_path, capsys):
    settings = (
        f"model={run_directory}",
        "device=cpu",
        "samples=2",
        "steps=2",
        f"output={tmp_path / 'out'}",
        "record=true",
    )
    run("actions", "actions", *settings, f"cache=[{cache}]", "sentences=1")
    trials = stmc.load(run_directory).vocabulary.calibration.trials
    assert {trial.action: trial.geometry is None for trial in trials.values()} == {"sit": False, "bow": True}
    assert all(trial.evaluator is not None and trial.steps == 2 for trial in trials.values())
    assert "success of 2 sentences stored" in capsys.readouterr().out
    (tmp_path / "texts.txt").write_text("bow # spine # head\nplay golf # spine\n")
    run("actions", "actions", *settings, f"texts={tmp_path / 'texts.txt'}", "seconds=2")
    after = stmc.load(run_directory).vocabulary.calibration.trials
    assert {**after, **trials} == after and len(after) == len(trials) + 2
    assert (after["bow"].action, after["bow"].samples, after["play golf"].action) == ("bow", 2, "golf")
    assert after["bow"].geometry == 0.0
    [bow] = stmc.load(run_directory).recognise(["bow"])
    assert bow.advice == "'bow' rarely works: 0 % of samples show it"


def test_thresholds_are_chosen_by_the_command_and_stored_where_asked(run_directory, capsys):
    settings = (f"model={run_directory}", "device=cpu", f"prompts={ROOT / 'tests/helpers/prompts.json'}")
    run("actions", "actions", *settings)
    printed = capsys.readouterr().out
    assert "before: missed without a warning: 0 of 0 texts" in printed and "unknown prompts that warn: " in printed
    assert not (run_directory / CALIBRATION).exists()
    run("actions", "actions", *settings, "record=true")
    vocabulary = stmc.load(run_directory).vocabulary
    threshold = vocabulary.calibration.threshold
    assert f"threshold: {threshold}" in capsys.readouterr().out
    assert vocabulary.recognise(["bow"], sentence_encoder())[0].threshold == threshold


def test_a_model_without_a_vocabulary_is_not_calibrated(tmp_path):
    folder = stmc.save(tiny(), tmp_path / "run", "")
    with pytest.raises(SettingError, match="no vocabulary"):
        run("actions", "actions", f"model={folder}", "device=cpu", "prompts=prompts.json")
