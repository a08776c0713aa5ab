"""What the site shows beside these pages: the models' cards, which travel with the models, and two pages of the
repository's root. A hook of mkdocs."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).parents[1]
CARDS = ("mdm_smpl_wide", "mdm_smpl_wide_fast", "mdm_smpl_cmu", "flow_mdm_wide", "tmr_wide")
PAGES = {f"cards/{name}.md": f"stmc/assets/{name}/README.md" for name in CARDS} | {
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}
"""Where a page stands in the site, and where in the repository."""
FILES = {f"cards/{name}": f"stmc/assets/mdm_smpl_wide/{name}" for name in ("example.png", "trainings.yaml")}


def brought(place: str) -> str:
    """The text of a page that stands elsewhere in the repository, with its links as they are in the site."""
    text, up = (ROOT / PAGES[place]).read_text("utf-8"), "../" * place.count("/")
    text = text.replace("](../../../docs/", f"]({up}").replace("](docs/", f"]({up}")
    return re.sub(r"\]\(\.\./(\w+)/README\.md", r"](\1.md", text)  # from one card to another


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Adds the pages, and what they show and link to."""
    from mkdocs.structure.files import File  # not above: the links are tested where mkdocs is not installed

    for place in PAGES:
        files.append(File.generated(config, place, content=brought(place)))
    for place, source in FILES.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / source)))
    return files
