"""Makes the notebooks of the pages that have their cells: `python docs/notebooks.py` fills docs/notebooks/.

A page is the source, so that what is read and what is run cannot differ. Cells are the blocks marked `python`;
everything between them is text, without links and pictures, which lead nowhere from a notebook.
"""

import json
import re
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


def main() -> None:
    for name, page in PAGES.items():
        (HERE / "notebooks" / f"{name}.ipynb").write_text(notebook((HERE / page).read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
