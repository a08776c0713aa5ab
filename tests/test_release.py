"""A release holds together: one version, extras that messages name and a bare install does without, pinned versions,
workflows that can be read, and no large file beside the weights."""

import re
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions

import pytest
import yaml
from helpers.scripts import ROOT
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import stmc
from stmc.cli.dispatch import command_summaries
from stmc.io.extras import EXTRAS, missing_extra, require
from stmc.run import bundled
from stmc.run.directories import BUNDLED

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
OPTIONAL = PROJECT["optional-dependencies"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
LARGEST = 2**20
WITHOUT_EXTRAS = f"import sys; sys.modules |= dict.fromkeys({sorted(EXTRAS)})\n"
"""Begins a program in which no extra is installed."""


def requirements(*extras: str) -> dict[str, Requirement]:
    """Return the packages that some extras install, those of the extras that they name too."""
    packages: dict[str, Requirement] = {}
    for extra in extras:
        for text in OPTIONAL[extra]:
            requirement = Requirement(text)
            own = requirement.name == PROJECT["name"]
            packages |= requirements(*requirement.extras) if own else {canonicalize_name(requirement.name): requirement}
    return packages


def run(code: str, folder=None) -> str:
    done = subprocess.run([sys.executable, "-c", WITHOUT_EXTRAS + code], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_the_version_stands_in_one_place_and_the_citation_follows():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == stmc.__version__
    assert "version" not in PROJECT and "version" in PROJECT["dynamic"]


def test_the_changelog_begins_with_this_version():
    versions = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text("utf-8"), flags=re.MULTILINE)
    assert versions[0] in (stmc.__version__, "Unreleased")
    assert stmc.__version__ in versions


@pytest.mark.parametrize("module", sorted(EXTRAS))
def test_an_extra_that_a_message_names_installs_the_package(module):
    distribution, extra = EXTRAS[module]
    assert canonicalize_name(distribution) in requirements(extra)
    assert canonicalize_name(distribution) in requirements("all")
    base = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"]}
    assert canonicalize_name(distribution) not in base
    assert distribution in packages_distributions().get(module, [distribution])


def test_every_extra_of_the_library_is_named_by_a_message_or_is_a_collection():
    named = {extra for _, extra in EXTRAS.values()}
    assert set(OPTIONAL) - named == {"all", "docs", "slurm", "test"}


def test_a_bare_install_samples_writes_and_reads(tmp_path):
    code = (
        "import stmc\n"
        "[motion] = stmc.load().generate('walk # 0 # 1', seed=0, steps=1)\n"
        "for suffix in ('npz', 'bvh', 'glb', 'csv', 'xml'): stmc.write(motion, f'walk.{suffix}')\n"
        "print(stmc.read('walk.npz').duration, stmc.read('walk.bvh').duration)"
    )
    assert run(code, tmp_path) == "1.0 1.0\n"


def test_a_missing_extra_is_named_in_python_and_by_the_command_line():
    code = (
        "import importlib, stmc\n"
        "from stmc.cli.exit_codes import explain_error\n"
        "tried = [lambda: stmc.plot_plan, lambda: stmc.render_film]\n"
        "modules = ('stmc.training.loop', 'stmc.training.device')\n"
        "tried += [lambda name=name: importlib.import_module(name) for name in modules]\n"
        "for each in tried:\n"
        "    try: each()\n"
        "    except ModuleNotFoundError as error: print(explain_error(error))"
    )
    advice = [re.fullmatch(r"this needs (\S+): pip install 'stmc\[(\w+)\]'", line) for line in run(code).splitlines()]
    figures, train = ("matplotlib", "figures"), ("accelerate", "train")
    assert [each.groups() for each in advice] == [figures, figures, train, train]


def test_without_extras_every_help_is_told_and_a_format_that_needs_one_is_refused_before_sampling(tmp_path):
    names = sorted(command_summaries())
    code = (
        "import sys\n"
        "from stmc.cli.dispatch import program\n"
        f"assert [program([name, '--help']) for name in {names}] == [0] * {len(names)}\n"
        "sys.stderr = sys.stdout\n"
        "for kind in ('webp', 'mp4'):\n"
        "    assert program(['sample', 'walk # 0 # 1', 'outputs/', f'formats={kind}', 'model=nowhere']) == 2\n"
        "assert program(['studio', 'folder=studio', 'model=nowhere']) == 2"
    )
    told = run(code, tmp_path)
    assert told.count("Usage: stmc ") == len(names)
    assert re.findall(r"this needs .*stmc\[(\w+)\]", told) == ["figures", "figures", "studio"]


def test_other_missing_modules_are_no_extras():
    assert missing_extra(ModuleNotFoundError("No module named 'nothing'", name="nothing")) is None
    assert missing_extra(ValueError("starlette")) is None
    require()


def test_versions_are_pinned_for_every_package_that_an_install_names():
    lines = [line.partition("#")[0].strip() for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()]
    pins = [Requirement(line) for line in lines if line]
    for python in ("3.11", "3.12", "3.13"):
        for system in ("Linux", "Darwin", "Windows"):
            place = {"python_version": python, "python_full_version": f"{python}.0", "platform_system": system}
            place |= {"sys_platform": {"Linux": "linux", "Darwin": "darwin", "Windows": "win32"}[system]}
            holding = {canonicalize_name(pin.name): pin for pin in pins if not pin.marker or pin.marker.evaluate(place)}
            asked = requirements("all", "test", "docs") | {
                canonicalize_name(Requirement(text).name): Requirement(text) for text in PROJECT["dependencies"]
            }
            assert sorted(asked.keys() - holding.keys()) == []
            wrong = [
                str(asked[name])
                for name in asked
                for each in holding[name].specifier
                if each.operator != "==" or not asked[name].specifier.contains(each.version)
            ]
            assert wrong == [], (python, system)


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_a_workflow_names_extras_markers_and_files_that_are_there(path):
    text = path.read_text("utf-8")
    jobs = yaml.safe_load(text)["jobs"]
    assert jobs and all("uses" in job or (job["steps"] and job["runs-on"]) for job in jobs.values())
    extras = {extra for found in re.findall(r'"\.\[([\w,]+)\]"', text) for extra in found.split(",")}
    assert extras <= set(OPTIONAL)
    assert [
        name for name in re.findall(r"(?:tests/[\w/]+\.py|constraints\.txt)", text) if not (ROOT / name).exists()
    ] == []


def test_the_tests_run_on_every_system_and_python_and_on_the_lowest_versions():
    tests = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text("utf-8"))["jobs"]
    matrix = tests["tests"]["strategy"]["matrix"]
    pythons = {each.rpartition(" ")[2] for each in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", each)}
    assert set(matrix["python"]) == pythons
    assert {each.partition("-")[0] for each in matrix["system"]} == {"ubuntu", "windows", "macos"}
    assert "lowest" in tests


def test_no_file_but_weights_and_their_pictures_is_large():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True)
    if listed.returncode:
        pytest.skip("no checkout of git")
    paths = [ROOT / name for name in listed.stdout.decode().split("\0") if name]
    large = {path.relative_to(ROOT).as_posix() for path in paths if path.exists() and path.stat().st_size > LARGEST}
    assert {name for name in large if not name.startswith("stmc/assets/")} == set()


@pytest.mark.parametrize(("size", "code"), [(LARGEST, 0), (LARGEST + 1, 1)])
def test_the_hook_refuses_a_large_file(tmp_path, size, code):
    [repository] = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"]
    [entry] = [hook["entry"] for hook in repository["hooks"] if hook["id"] == "large-files"]
    (tmp_path / "a.bin").write_bytes(bytes(size))
    _, *arguments = shlex.split(entry)
    done = subprocess.run([sys.executable, *arguments, "a.bin"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == code and ("a.bin: above 1 MB" in done.stderr) == bool(code)


def test_the_readme_names_the_licence_of_the_default_model_and_a_free_one_in_one_line():
    readme = (ROOT / "README.md").read_text("utf-8").splitlines()
    [line] = [line for line in readme if line.startswith("**Licence of the models**")]
    assert "CC BY-NC 4.0" in line and 'stmc.load("mdm_smpl_cmu")' in line and "MIT" in line
    for name, licence in ((BUNDLED, "CC BY-NC 4.0"), ("mdm_smpl_cmu", "MIT")):
        assert licence in (bundled(name) / "README.md").read_text("utf-8")
