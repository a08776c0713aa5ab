"""Commands: how settings are typed and checked, what help says, and how every script ends when something goes wrong."""

import dataclasses
import inspect
import os
import random
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool

import pytest
import torch
from helpers.own_folder import install_wheel
from helpers.scripts import ROOT, configured, loaded
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import stmc
from stmc.cli.arguments import parse_arguments, quote_override
from stmc.cli.commands import Command
from stmc.cli.dispatch import module_summaries, program
from stmc.cli.exit_codes import MAX_CHARACTERS, explain_error, run_guarded
from stmc.editing.generate_request import GenerateRequest
from stmc.settings.records import defaults, field_infos

SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("*.py"))
NEEDED = {
    "analyse_study": ["answers=nowhere"],
    "attention": ["model=nowhere"],
    "baselines": ["timelines=nowhere.txt"],
    "benchmark": ["timelines=nowhere.txt"],
    "embed": ["texts=nowhere"],
    "import_checkpoint": ["source=nowhere", "output=nowhere"],
    "study": ["first=a", "second=b", "timelines=nowhere.txt"],
    "train": ["run=nowhere", "data.folder=nowhere"],
    "train_tmr": ["run=nowhere", "data.folder=nowhere"],
}
"""What must be given for a command's checks to pass."""


@pytest.fixture(scope="module")
def found() -> dict[str, Command]:
    """Every script's command."""
    return {name: loaded(name).main for name in SCRIPTS}


@pytest.fixture
def sample(found) -> Command:
    """Sampling that stops once its settings are checked."""
    return idle(found["sample"])


def idle(command: Command) -> Command:
    return dataclasses.replace(command, function=lambda config: None)


def ended(command: Command, arguments: list[str], capsys) -> tuple[int, str]:
    """The exit code, and what was told on stderr."""
    capsys.readouterr()
    code = command(arguments)
    return code, capsys.readouterr().err


# How settings are typed ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["my file (1).txt", "it's.txt", 'say "hi".txt', "a,b.txt", "[x].txt", "2024", "1e3", "true", "a=b.txt", "ü #"],
)
def test_a_file_name_is_taken_as_it_is_typed(sample, name):
    forms = ([f"timeline={name}"], ["--timeline", name], [f"--timeline={name}"])
    asked, *others = (
        parse_arguments(arguments, sample.settings, sample.parts, sample.positional) for arguments in forms
    )
    assert sample.compose_config(asked).timeline == name
    assert others == [asked, asked]


def test_plain_arguments_are_the_timeline_and_the_folder(sample):
    asked = parse_arguments(["walk # 0 # 4", "out/", "--json"], sample.settings, sample.parts, sample.positional)
    config = sample.compose_config(asked)
    assert (config.timeline, config.output, config.json) == ("walk # 0 # 4", "out/", True)


def test_a_list_needs_no_brackets(sample):
    for typed in ("formats=npz,bvh", "formats=[npz,bvh]", "--formats=npz,bvh"):
        asked = parse_arguments([typed], sample.settings, sample.parts, sample.positional)
        assert list(sample.compose_config(asked).formats) == ["npz", "bvh"]


def test_what_is_quoted_reads_back_as_it_was():
    draw = random.Random(0)
    for _ in range(300):
        text = "".join(draw.choices("ab'\"\\ (),=[]{}:#$", k=draw.randint(1, 9)))
        if text[0] != text[-1] or text[0] not in "'\"":
            assert OverridesParser.create().parse_override(f"key={quote_override(text)}").value() == text


def test_a_folder_of_one_s_own_wins_over_ours(sample, tmp_path):
    (tmp_path / "sample.yaml").write_text("steps: 7\n")
    (tmp_path / "quick.yaml").write_text("defaults: [sample, _self_]\nseed: 3\n")
    asked = parse_arguments(["--config-dir", str(tmp_path)], sample.settings, sample.parts, sample.positional)
    assert (sample.compose_config(asked).steps, sample.compose_config(asked).samples) == (7, 1)
    asked = parse_arguments(
        [f"--config-dir={tmp_path}", "-cn", "quick"], sample.settings, sample.parts, sample.positional
    )
    assert (sample.compose_config(asked).steps, sample.compose_config(asked).seed) == (7, 3)


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_command_takes_a_folder_of_one_s_own_beside_ours(found, name, tmp_path, capsys):
    """Of another group than the command's, so that its own configuration, and all others, come from ours."""
    (tmp_path / "denoiser").mkdir()
    (tmp_path / "denoiser" / "mine.yaml").write_text("_target_: mylab.Mine\n")
    given = [*NEEDED.get(name, []), "--config-dir", str(tmp_path)]
    assert ended(idle(found[name]), given, capsys) == (0, "")
    if "denoiser" in found[name].parts:
        seen = dataclasses.replace(found[name], function=lambda config: print(config.denoiser._target_))
        assert seen([*given, "denoiser=mine"]) == 0
        assert capsys.readouterr().out == "mylab.Mine\n"


def test_a_folder_of_one_s_own_is_forgotten_after_the_command(sample, tmp_path):
    (tmp_path / "sample.yaml").write_text("steps: 7\n")
    for given, steps in ((["--config-dir", str(tmp_path)], 7), ([], None)):
        config = sample.compose_config(parse_arguments(given, sample.settings, sample.parts, sample.positional))
        assert config.steps == steps


def test_feet_are_cleaned_by_default_wherever_motions_are_generated_and_never_where_they_are_measured(found):
    generate = inspect.signature(stmc.Model.generate).parameters["clean_feet"].default
    assert (
        generate is defaults(found["sample"].settings)["clean_feet"] is defaults(GenerateRequest)["clean_feet"] is True
    )
    for name in ("abilities", "benchmark", "benchmark_length", "evaluate"):
        calls = (ROOT / "stmc" / "cli" / f"{name}.py").read_text("utf-8").split("model.generate(")[1:]
        assert calls and all("clean_feet=False" in call for call in calls)


# What is refused -----------------------------------------------------------------------------------------------------

REFUSED = {
    "steps=1000000000 seed=-1": "seed=-1: must be at least 0",
    "steps=ten": "steps='ten': must be a whole number or null, at least 1",
    "steps=1.5": "steps=1.5: must be a whole number or null",
    "steps=0": "steps=0: must be at least 1",
    "guidance=nan": "guidance=nan: must be a number or null",
    "guidance=inf": "guidance=inf: must be a number or null",
    "guidance=x": "guidance='x': must be a number or null",
    "guidance=[]": "must be a number or null",
    "overlap=inf": "overlap=inf: must be a number or null, at least 0 s",
    "overlap=x": "overlap='x': must be a number or null, at least 0 s",
    "overlap=-0.01": "overlap=-0.01: must be at least 0 s",
    "stitch_from=x": "stitch_from='x'",
    "stitch_from=1": "stitch_from=1: must be at least 0 and below 1",
    "batch=x": "batch='x': must be a whole number or null",
    "batch=1.5": "batch=1.5: must be a whole number or null",
    "samples=1e6": "samples=1000000.0: must be a whole number",
    "samples=x": "samples='x': must be a whole number",
    "seed=x": "seed='x': must be a whole number",
    "seed=1.5": "seed=1.5: must be a whole number",
    "seed=null": "seed=null: must be a whole number",
    "formats=3": "formats=[3]: must be a list or null, one of npz, bvh, html",
    "formats=[fbx]": "formats='fbx': choose from npz, bvh, html",
    "method=magic": "method='magic': choose from one_text, single_track",
    "output=": "output='': must not be empty",
    "stteps=3": "unknown setting 'stteps': did you mean steps?",
    "+x=1": "unknown setting 'x'",
    "--stteps 3": "unknown setting '--stteps'",
    "--steps": "--steps needs a value",
    "timeline=${nobody}": "'nobody' not found",
    "~nobody": "'nobody' does not exist",
    "a b c": "'c' is not a setting",
    "--config-name nobody": "nobody.yaml does not exist",
    "--config-dir nobody": "nobody is not a folder",
}


@pytest.mark.parametrize("arguments", REFUSED)
def test_a_setting_that_does_not_fit_is_one_sentence(sample, arguments, capsys):
    code, told = ended(sample, arguments.split(), capsys)
    assert code == 2
    assert REFUSED[arguments] in told
    assert told.count("\n") == 1
    assert len(told) < 400


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["device=cuda:99"], "device 'cuda:99' is unknown or not available here"),
        (["device=bogus"], "device 'bogus' is unknown or not available here"),
        (["output=/proc/x"], "/proc/x"),
        (["timeline=nowhere.txt"], "nowhere.txt: no such file"),
        (["walk # 3 # 1"], "line 1: end 1 must be later than start 3"),
        (["model=nowhere"], "nowhere is not a run directory"),
        (["stitch_from=0.5", "method=sinc"], "0.5"),
        (["formats=[]"], "choose from npz, bvh, html"),
        (["walk # 0 # 61", "formats=[npz,webp]"], "a .webp film has at most 1,200 pictures, not 1,220"),
        (["walk # 0 # 30", "fps=60", "formats=[gif]"], "a .gif film has at most 1,200 pictures, not 1,800"),
    ],
)
def test_what_sampling_cannot_do_is_one_sentence_and_nothing_is_sampled(found, arguments, message, tmp_path, capsys):
    output = [] if any(each.startswith("output=") for each in arguments) else [f"output={tmp_path / 'out'}"]
    code, told = ended(found["sample"], [*arguments, *output], capsys)
    assert code == 2
    assert message in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


WILD = (
    *("x", "", "-1", "0", "1.5", "1e400", "nan", "-inf", "null", "true", "[]", "[[1", "{a:1}", "{", "'", '"', "\\"),
    *(
        "${x}",
        "${oc.env:NOBODY}",
        "a,b",
        "%s",
        "# 0 # 1",
        "9" * 400,
        "é\udcff",
        "~",
        "!!python/name:os.system",
        "a" * 1000,
    ),
)


def check_wild_settings(commands: dict[str, Command], draws: int, seed: int, capsys) -> None:
    """Settings, groups and keys with wild values: either they pass the checks, or one short line says why not."""
    draw = random.Random(seed)
    for _ in range(draws):
        command = idle(commands[draw.choice([*SCRIPTS, *["sample"] * 4 * len(SCRIPTS)])])
        keys = [*field_infos(command.settings), *command.parts, "nobody", "a.b", "+c", "~steps", "--device", "-x"]
        arguments = [f"{draw.choice(keys)}={draw.choice(WILD)}" for _ in range(draw.randint(1, 3))]
        code, told = ended(command, arguments, capsys)
        assert code in (0, 2), arguments
        assert (code == 0) == (told == ""), (arguments, told)
        assert told.count("\n") <= 1, (arguments, told)
        assert len(told) < 400, (arguments, told)


def test_wild_settings_end_in_one_line(found, capsys):
    check_wild_settings(found, 20, 0, capsys)


@pytest.mark.slow
def test_a_thousand_wild_settings_end_in_one_line(found, capsys):
    check_wild_settings(found, 1000, 1, capsys)


# The records and the configurations ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_configuration_has_the_defaults_of_the_record(found, name):
    config = OmegaConf.to_container(OmegaConf.load(ROOT / "configs" / f"{name}.yaml"))
    stated = {key: value for key, value in config.items() if key != "defaults" and key not in found[name].parts}
    first = {
        key: "???" if value is dataclasses.MISSING else value for key, value in defaults(found[name].settings).items()
    }
    assert stated == {key: plain(value) for key, value in first.items()}


def plain(value: object) -> object:
    return [plain(each) for each in value] if isinstance(value, tuple) else value


def test_every_configuration_of_a_script_passes_its_checks(found):
    for path in sorted((ROOT / "configs").glob("*.yaml")):
        name = next(name for name in sorted(SCRIPTS, key=len, reverse=True) if kin(path.stem, name))
        config = configured(path.stem, *NEEDED.get(name, []))
        found[name].check(config)


def kin(config: str, script: str) -> bool:
    return config == script or (script.startswith("train") and config.startswith(f"{script}_"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_says_what_every_setting_is(found, name, capsys):
    assert found[name](["--help"]) == 0
    told = " ".join(capsys.readouterr().out.split())
    for setting, each in field_infos(found[name].settings).items():
        assert f" {setting} {each.help}" in told
        assert all(choice in told for choice in each.choices)
    for part, (chosen, names) in found[name].parts.items():
        assert f" {part} {', '.join(names)} [{chosen}]" in told


@pytest.mark.parametrize(
    ("recipe", "own", "others"),
    [("balanced", "pool", "drop_last"), ("epochs", "drop_last", "pool"), ("packed", "texts_per_row", "drop_last")],
)
def test_help_lists_the_settings_of_the_recipe_that_is_chosen(found, recipe, own, others, capsys):
    assert found["train"](["--help", f"data/sampling={recipe}"]) == 0
    told = capsys.readouterr().out
    assert f"\n  {own} " in told and "\n  rows " in told and f"\n  {others} " not in told
    assert "[128]" in told  # as configured


# How a command ends --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_script_ends_in_one_line_when_it_is_stopped(found, name, capsys):
    command = dataclasses.replace(found[name], function=raising(KeyboardInterrupt()))
    assert ended(command, NEEDED.get(name, []), capsys) == (130, "Interrupted. Run the same command again to resume.\n")


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(28, "No space left on device", "/out/a.npz"), "/out/a.npz: no space left on device"),
        (ModuleNotFoundError("No module named 'accelerate'", name="accelerate"), "pip install 'stmc[train]'"),
        (BrokenProcessPool(), "a worker process was killed, perhaps for lack of memory"),
    ],
)
def test_what_a_user_can_mend_is_one_line(error, message, capsys):
    assert run_guarded(lambda: raising(error)(None)) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1


def test_a_bug_keeps_its_traceback():
    with pytest.raises(TypeError, match="a bug"):
        run_guarded(lambda: raising(TypeError("a bug"))(None))


def raising(error: BaseException):
    def function(config):
        raise error

    return function


@pytest.mark.parametrize("name", sorted(NEEDED))
def test_what_must_be_given_is_asked_for_before_anything_is_loaded(found, name, capsys):
    code, told = ended(found[name], [], capsys)
    assert code == 2
    assert told.startswith("missing: ")
    assert NEEDED[name][0].partition("=")[0] in told


def test_what_follows_from_what_must_be_given_is_not_asked_for(found, capsys):
    code, told = ended(found["evaluate"], ["benchmark=flow_mdm_humanml3d"], capsys)
    assert code == 2 and told.startswith("missing: benchmark.compositions.path=, ")
    assert "benchmark.references.folder=" in told and "tags" not in told


@pytest.mark.parametrize("typed", ["models.mine=runs/mine", "models={mine: runs/mine}"])
def test_a_key_of_one_s_own_is_told_to_need_a_plus(found, typed, capsys):
    code, told = ended(found["evaluate"], [typed], capsys)
    assert (code, told) == (2, "there is no setting models.mine; add a key of your own with a plus: +models.mine=…\n")


def test_a_value_error_of_ours_is_a_sentence_and_one_of_torch_a_bug():
    assert explain_error(caught(lambda: stmc.Timeline.parse("walk # 3 # 1"))) is not None
    assert explain_error(caught(lambda: torch.distributions.Normal(0.0, -1.0))) is None


def caught(run) -> Exception:
    try:
        run()
    except ValueError as error:
        return error
    raise AssertionError("no error")


def test_a_message_is_one_line_however_long_and_odd_it_is(capsys):
    odd = {"a\nb\x00\x1b[2J" + "x" * 10_000: 1}
    assert run_guarded(lambda: stmc.settings.records.record_of(stmc.Sampling, odd)) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert len(told) <= MAX_CHARACTERS + 2
    assert "\x1b" not in told


def test_a_warning_of_the_library_is_one_line_without_code(capsys):
    clash = "walk # 0 # 2 # legs\nrun # 0 # 2 # legs"
    assert run_guarded(lambda: stmc.assign(stmc.Timeline.parse(clash), fps=20)) == 0
    told = capsys.readouterr().err.splitlines()
    assert told
    assert all(line.startswith("warning: ") and ".py" not in line for line in told)


# One program ---------------------------------------------------------------------------------------------------------


def test_one_program_lists_and_runs_all_scripts(capsys):
    assert program([]) == 0
    told = capsys.readouterr().out
    assert set(module_summaries()) == set(SCRIPTS)
    assert all(f"  {'import' if name == 'import_checkpoint' else name} " in told for name in SCRIPTS)
    assert program(["sample", "steps=0"]) == 2
    assert "steps=0" in capsys.readouterr().err
    assert program(["nobody"]) == 2
    assert capsys.readouterr().err.startswith("unknown command 'nobody': choose from abilities, ")


@pytest.mark.parametrize(("typed", "meant"), [("sampel", "sample"), ("improt", "import"), ("train-tmrr", "train_tmr")])
def test_a_misspelt_command_is_answered_with_the_nearest_as_help_lists_it(typed, meant, capsys):
    assert program([typed]) == 2
    assert capsys.readouterr().err == f"unknown command '{typed}': did you mean {meant}?\n"


SLOW_TO_IMPORT = ("matplotlib", "roma", "scipy", "sympy", "torch._dynamo", "transformers", "trimesh")


@pytest.mark.parametrize(
    ("typed", "forbidden"),
    [
        (["--help"], ("torch", "numpy", "rich", "stmc.cli.sample", *SLOW_TO_IMPORT)),
        (["sample", "--help"], ("stmc.formats.characters", "stmc.motion.retargeting", *SLOW_TO_IMPORT)),
    ],
    ids=" ".join,
)
def test_help_imports_nothing_slow_but_torch_and_the_list_of_commands_not_even_that(typed, forbidden):
    code = (
        f"import sys; from stmc.cli.dispatch import program; program({typed})\n"
        f"print({{*sys.modules}} & {{*{forbidden}}})"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, text=True, capture_output=True)
    assert done.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_speaks_of_no_file_that_a_wheel_lacks(name, capsys):
    assert loaded(name).main(["--help"]) == 0
    told = capsys.readouterr().out
    assert "scripts/" not in told
    assert "configs/" not in told.replace("mylab/configs", "")


@pytest.mark.slow
def test_ctrl_c_while_sampling_is_one_line_and_leaves_no_temporary(tmp_path):
    command = [sys.executable, str(ROOT / "scripts/sample.py"), "walk # 0 # 4", str(tmp_path), "samples=50", "batch=1"]
    # A shell's background job ignores the signal, and so would a child of it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)
    assert any("(1 of 50)" in line for line in running.stdout)  # a slow machine tells of steps before
    running.send_signal(signal.SIGINT)
    _, told = running.communicate(timeout=120)
    assert running.returncode == 130
    assert told == "Interrupted. Run the same command again to resume.\n"
    assert list(tmp_path.glob("*.npz"))
    assert not list(tmp_path.glob(".*"))


@pytest.mark.slow
def test_a_wheel_has_the_command_the_configurations_and_no_result_pages(tmp_path):
    pytest.importorskip("setuptools", minversion="77")
    place = install_wheel(tmp_path / "wheel")
    assert not list(place.rglob("assets/results"))
    assert (place / "stmc/py.typed").exists()
    environment = os.environ | {"PYTHONPATH": str(place)}

    def run(*arguments: str) -> str:
        command = [str(place / "bin/stmc"), *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, text=True, capture_output=True, check=True)
        return done.stdout

    assert "import " in run("--help")
    assert "how crops become a motion" in run("sample", "--help")
    assert '"seconds": 2.0' in run("sample", "walk # 0 # 2", "out", "steps=2", "--json")
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".npz", ".bvh", ".html", ".json"}
