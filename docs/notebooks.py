"""Makes the notebooks of the pages that have their cells: `python docs/notebooks.py` fills docs/notebooks/.

A page is the source, so that what is read and what is run cannot differ. Cells are the blocks marked `python`;
everything between them is text, without links and pictures, which lead nowhere from a notebook. The notebooks are run
and stored with their outputs, so that they can be read where nothing runs them; it needs nbclient and ipykernel.
"""

import json
import re
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
PAGES = {"sample": "sampling.md", "rule": "extending/rule.md", "denoiser": "extending/denoiser.md"}


def notebook(page: str) -> str:
    """The text of the notebook of a page's text: no outputs, the same file each time."""
    cells = []
    for number, text in enumerate(re.split(r"^```python\n(.*?)^```$", page, flags=re.DOTALL | re.MULTILINE)):
        source = (text if number % 2 else unlinked(text)).strip("\n")
        if source:
            cells.append(cell(source, bool(number % 2), len(cells)))
    language = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    whole = {"cells": cells, "metadata": language, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def cell(source: str, code: bool, number: int) -> dict:
    """One cell as nbformat 4.5 writes it."""
    made = {"id": f"cell-{number}", "metadata": {}, "source": source.splitlines(keepends=True)}
    kind = {"cell_type": "code", "execution_count": None, "outputs": []} if code else {"cell_type": "markdown"}
    return kind | made


def unlinked(text: str) -> str:
    """Markdown without pictures, comments and links' targets."""
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)\n?|<!--.*?-->\n?", "", text)
    return re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", text)


def without_outputs(text: str) -> str:
    """A notebook as `notebook` makes it, of one that was run."""
    whole = json.loads(text)
    for each in whole["cells"]:
        if each["cell_type"] == "code":
            each |= {"execution_count": None, "outputs": []}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def executed(text: str) -> str:
    """A notebook with its outputs: run in an empty folder, cell by cell."""
    import nbformat
    from nbclient import NotebookClient

    book = nbformat.reads(text, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(book, timeout=600, resources={"metadata": {"path": folder}}, record_timing=False).execute()
    whole = json.loads(text)
    for blank, run in zip(whole["cells"], json.loads(nbformat.writes(book))["cells"], strict=True):
        if blank["cell_type"] == "code":
            blank |= {"execution_count": run["execution_count"], "outputs": run["outputs"]}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    for name, page in PAGES.items():
        made = executed(notebook((HERE / page).read_text("utf-8")))
        (HERE / "notebooks" / f"{name}.ipynb").write_text(made, "utf-8")


if __name__ == "__main__":
    main()
