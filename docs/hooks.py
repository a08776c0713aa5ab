"""What the site shows beside these pages: the models' cards, which travel with the models, and two pages of the
repository's root. A hook of mkdocs."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
CARDS = ("mdm_smpl_wide", "mdm_smpl_wide_fast", "mdm_smpl_cmu", "flow_mdm_wide", "tmr_wide")
PAGES = {f"cards/{name}.md": f"stmc/assets/{name}/README.md" for name in CARDS} | {
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}
"""Where a page stands in the site, and where in the repository."""
FILES = {f"cards/{name}": f"stmc/assets/mdm_smpl_wide/{name}" for name in ("example.png", "trainings.yaml")}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages, their links as they are from there, and what they show and link to."""
    for place, source in PAGES.items():
        text = (ROOT / source).read_text("utf-8")
        up = "../" * place.count("/")
        text = text.replace("](../../../docs/", f"]({up}").replace("](docs/", f"]({up}")
        files.append(File.generated(config, place, content=text))
    for place, source in FILES.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / source)))
    return files
