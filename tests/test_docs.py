"""The pages are true: their links lead somewhere, and the names, settings, commands and tests that they name exist."""

import importlib
import inspect
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from helpers.scripts import ROOT
from test_architecture import TIERS

import stmc
from stmc.cli.arguments import parse_arguments
from stmc.cli.dispatch import SHORT, find_command, module_summaries
from stmc.composing import METHODS
from stmc.composing.sampling import DEFAULT, Sampling
from stmc.model import Model
from stmc.settings.records import field_infos
from stmc.timeline import prompts
from stmc.timeline import timeline_files as files

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
ALL = [*PAGES, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))]
ALL += sorted((ROOT / "stmc/assets").rglob("*.md"))
SITE = runpy.run_path(str(DOCS / "notebooks.py"))
HOOKS = runpy.run_path(str(DOCS / "hooks.py"))
BROUGHT = HOOKS["PAGES"] | HOOKS["FILES"]
"""What docs/hooks.py brings into the site, and from where."""


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def text(page: Path) -> str:
    return page.read_text("utf-8")


def prose(page: Path) -> str:
    return re.sub(r"^ *```.*?^ *```$", "", text(page), flags=re.DOTALL | re.MULTILINE)


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text(page), flags=re.DOTALL | re.MULTILINE)


def slug(heading: str) -> str:
    """The anchor that mkdocs gives a heading."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", re.sub(r"`", "", heading)).strip().lower())


def anchors(page: Path) -> set[str]:
    return {slug(heading) for heading in re.findall(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)}


def followed(page: Path, link: str) -> Path:
    """The file that a relative link of a page is about, also where the site brings it from elsewhere."""
    target = (page.parent / link).resolve() if link else page
    if target.is_relative_to(DOCS) and target.relative_to(DOCS).as_posix() in BROUGHT:
        return ROOT / BROUGHT[target.relative_to(DOCS).as_posix()]
    return target


@pytest.mark.parametrize("page", [page for page in ALL if page.name != "CHANGELOG.md"], ids=name)
def test_lines_of_prose_have_at_most_120_characters(page):
    """So that a diff can be reviewed; rows of tables cannot be broken."""
    assert [line for line in prose(page).splitlines() if len(line) > 120 and not line.startswith("|")] == []


@pytest.mark.parametrize("page", ALL, ids=name)
def test_every_row_of_a_table_has_as_many_cells_as_its_head(page):
    for table in re.findall(r"(?:^\|.*\|\n)+", text(page), re.MULTILINE):
        cells = [len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()]
        assert len(set(cells)) == 1, table[:80]


@pytest.mark.parametrize("page", ALL, ids=name)
def test_every_link_of_a_page_leads_to_a_file_and_a_heading_that_are_there(page):
    for link in re.findall(r"\]\((?!https?:|mailto:)([^)\s]+)\)", prose(page)):
        path, _, anchor = link.partition("#")
        target = followed(page, path)
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def test_the_navigation_has_every_page_once():
    config = yaml.safe_load(text(ROOT / "mkdocs.yml").replace("!!", ""))

    def listed(node) -> list[str]:
        if isinstance(node, str):
            return [node]
        return [page for each in (node.values() if isinstance(node, dict) else node) for page in listed(each)]

    pages = [page for page in BROUGHT if page.endswith(".md")] + [page.relative_to(DOCS).as_posix() for page in PAGES]
    assert sorted(listed(config["nav"])) == sorted(pages)


@pytest.mark.parametrize("page", sorted(HOOKS["PAGES"]))
def test_the_links_of_what_the_site_brings_from_elsewhere_lead_to_pages_of_the_site(page):
    links = re.findall(r"\]\((?!https?:|mailto:|#)([^)\s#]+)", HOOKS["brought"](page))
    places = [os.path.normpath(os.path.join(os.path.dirname(page), link)) for link in links]
    assert [place for place in places if place not in BROUGHT and not (DOCS / place).exists()] == []


def test_every_public_name_is_in_the_reference():
    described = {each for page in DOCS.glob("reference/*.md") for each in re.findall(r"^::: (\S+)$", text(page), re.M)}
    for each in described:
        resolved(each)
    objects = {id(resolved(each)) for each in described}
    assert [
        name
        for name in stmc.__all__
        if not inspect.ismodule(getattr(stmc, name)) and id(getattr(stmc, name)) not in objects
    ] == []


def resolved(dotted: str):
    """What a dotted name is: a module, or an attribute of one; a dataclass's field counts."""
    parts = dotted.split(".")
    found = importlib.import_module(parts[0])
    for number, part in enumerate(parts[1:], start=2):
        if part in getattr(found, "__dataclass_fields__", {}) or part in getattr(found, "__annotations__", {}):
            return found
        try:
            found = getattr(found, part)
        except AttributeError:
            found = importlib.import_module(".".join(parts[:number]))
    return found


@pytest.mark.parametrize("page", ALL, ids=name)
def test_every_name_of_the_library_that_a_page_says_exists(page):
    for dotted in re.findall(r"`(stmc(?:\.\w+)+)", prose(page)):
        if not dotted.endswith("_"):  # the beginning of names, as in `published_…`
            resolved(dotted)


@pytest.mark.parametrize("page", ALL, ids=name)
def test_every_file_of_the_repository_and_every_test_that_a_page_names_is_there(page):
    for path, test in re.findall(r"`((?:scripts|configs|tests|docs|stmc)/[\w./-]*\w)(?:::(\w+))?`", prose(page)):
        assert (ROOT / path).exists(), path
        assert f"def {test}(" in text(ROOT / path) if test else True, test


def test_the_table_of_settings_is_the_record_s():
    own = dict(DEFAULT.given) | {"steps": "the schedule's"}
    rows = [
        f"| `{name}` | {told.help} | {told.fits} | {own.get(name, '–')} |"
        for name, told in field_infos(Sampling).items()
    ]
    assert "\n".join(rows) in text(DOCS / "sampling.md"), "\n".join(["the rows should be:", *rows])


def test_the_limits_of_timelines_are_the_library_s():
    limits = (
        prompts.LATEST, prompts.MOST_FRAMES, prompts.MOST_PROMPTS, files.MOST_PROMPTS_IN_FILE, prompts.LONGEST_TEXT,
    )  # fmt: skip
    page = text(DOCS / "timelines.md")
    assert [limit for limit in limits if f"| {limit:,}" not in page] == []
    assert f"| {files.MOST_BYTES // 2**20} MiB |" in page


def test_the_table_of_tiers_is_the_one_that_is_tested():
    rows = [f"| {tier} | {', '.join(f'`{each}`' for each in sorted(each))} |" for tier, each in enumerate(TIERS)]
    assert "\n".join(rows) in text(DOCS / "architecture.md"), "\n".join(["the rows should be:", *rows])


def test_every_method_is_described_with_its_plan_drawn():
    page = text(DOCS / "methods.md")
    assert [method for method in METHODS if f"[`{method}`](#" not in page] == []
    drawn = set(re.findall(r"\((?:\.\./)?figures/(\w+)\.png\)", "".join(text(page) for page in PAGES)))
    assert drawn == {path.stem for path in DOCS.glob("figures/*.png")}


EXTENDING = {
    page: dict(re.findall(r"^\| (read|edit, [^|]+) \| (\d+ \|[^|\n]*) \|$", text(page), flags=re.MULTILINE))
    for page in sorted((DOCS / "extending").glob("*.md"))
    if "| | count | places |" in text(page)
}
"""Pages that count what a new part takes: for each row its count and its places."""


@pytest.mark.parametrize("page", EXTENDING, ids=name)
def test_a_page_on_extending_counts_the_places_that_it_lists_as_the_index_does(page):
    for row in EXTENDING[page].values():
        count, places = row.split(" |")
        listed = [place for place in places.split(";") if place.strip()]
        assert int(count) in (len(listed), 0), row
    counts = [EXTENDING[page][row].split(" |")[0] for row in ("read", "edit, here")]
    [line] = re.findall(rf"^\| \[[^|]*\]\({page.name}\) \|.*$", text(DOCS / "extending/index.md"), re.MULTILINE)
    assert [cell.strip() for cell in line.strip("| ").split("|")][-2:] == counts


def test_a_page_on_extending_is_short_and_has_an_example_that_is_run():
    assert len(EXTENDING) >= 9
    assert [page.name for page in EXTENDING if not blocks(page, "python")] == []
    long = {page.name for page in EXTENDING if len(text(page).splitlines()) > 60}
    assert long <= {"data.md", "denoiser.md", "rule.md"}  # tutorials, two of them notebooks


def test_the_table_of_commands_has_every_command_once():
    rows = re.findall(r"^\| `stmc (\w+)", text(DOCS / "commands.md"), flags=re.MULTILINE)
    assert sorted(SHORT.get(row, row) for row in rows) == sorted(module_summaries())


COMMANDS = sorted(
    {
        line.strip()
        for page in ALL
        for block in blocks(page, "bash")
        for line in block.replace("\\\n", " ").splitlines()
        if line.startswith("stmc ") and "mylab" not in line
    }
    | {each for page in ALL for each in re.findall(r"`(stmc \w+ [^`|\n]*=[^`|\n]*)`", prose(page)) if "…" not in each}
)


@pytest.mark.slow
def test_every_command_of_the_pages_is_understood():
    """Its settings exist and fit; the models and files that it names need not be there."""
    assert len(COMMANDS) > 20
    for line in COMMANDS:
        understood(line)


def understood(line: str) -> None:
    _, script, *arguments = shlex.split(line, comments=True)
    command = find_command(script)
    try:
        asked = parse_arguments(arguments, command.settings, command.parts, command.positional)
        if not asked.multirun:  # whose values Hydra tells apart, and whose launcher need not be installed
            command.compose_config(asked)
    except Exception as error:
        raise AssertionError(f"{line}: {error}") from error


def test_the_first_command_of_the_readme_is_understood():
    assert "&& stmc sample\n" in text(ROOT / "README.md")
    understood("stmc sample")


@pytest.mark.parametrize("notebook", sorted(SITE["PAGES"]))
def test_a_notebook_is_the_one_of_its_page(notebook):
    page = text(DOCS / SITE["PAGES"][notebook])
    made = text(DOCS / "notebooks" / f"{notebook}.ipynb")
    assert json.loads(made)["nbformat"] == 4
    assert SITE["without_outputs"](made) == SITE["notebook"](page), "run python docs/notebooks.py"


@pytest.mark.parametrize("notebook", sorted(SITE["PAGES"]))
def test_a_notebook_is_stored_with_what_it_shows_small_and_without_warnings(notebook):
    path = DOCS / "notebooks" / f"{notebook}.ipynb"
    cells = [cell for cell in json.loads(text(path))["cells"] if cell["cell_type"] == "code"]
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert all(cell["execution_count"] for cell in cells)
    shown = {kind for output in outputs for kind in output.get("data", {})}
    assert shown & {"image/png", "text/html"}
    assert not [output for output in outputs if output["output_type"] in ("stream", "error")]
    assert path.stat().st_size < 400_000


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name)
def test_the_cells_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch):
    """Notebooks, too, since they are made of pages. With few steps: it is not the motion that is tested."""
    generate = Model.generate
    monkeypatch.setattr(Model, "generate", lambda *args, **settings: generate(*args, **settings | {"steps": 3}))
    monkeypatch.chdir(tmp_path)
    namespace: dict = {"__name__": "__main__"}
    for number, block in enumerate(blocks(page, "python"), start=1):
        exec(compile(block, f"{name(page)}, cell {number}", "exec"), namespace)


@pytest.mark.slow
def test_every_figure_is_one_that_is_drawn_from_a_plan():
    plans = runpy.run_path(str(DOCS / "figures.py"))["plans"]()
    assert set(plans) | {"stream"} == {path.stem for path in DOCS.glob("figures/*.png")}


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip("mkdocstrings", reason='pip install -e ".[docs]"')
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", tmp_path / "site"],
        cwd=ROOT, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    outside = re.findall(r'(?:src|href)="(https?://[^"]+\.(?:js|css|woff2?))"', text(tmp_path / "site/index.html"))
    assert not outside
