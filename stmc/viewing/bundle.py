"""Bundle JavaScript modules into one inline script, since browsers load no modules from files or into notebook frames.

This module supports the forms of imports and exports in our assets and three.js, and no others.
"""

from __future__ import annotations

import base64
import hashlib
import json
import posixpath
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

_LISTED = re.compile(r"(?:^|(?<=[;}]))(import|export)\s*\{([^}]*)\}\s*(?:from\s*[\"']([^\"']+)[\"'])?\s*;?", re.M)
"""`import {a, b as c} from "./x.js";`, `export {a as b};` and `export {a} from "./x.js";`."""
_DECLARED = re.compile(r"^export\s+(?=(?:async\s+)?(?:function|const|let|class)\s+(\w+))", re.M)
_COMMENT = re.compile(r"^[ \t]*/\*\*(?!\s*\*\s*@license).*?\*/[ \t]*\n", re.M | re.S)

_PLACE = re.compile(r"/\* (\w+) \*/")


def read_asset(path: str) -> str:
    """Read the text of a file in the package's assets."""
    return (files("stmc") / "assets" / path).read_text("utf-8")


def as_json(data: Any) -> str:
    """Encode data as JSON that is safe inside `<script type="application/json">`."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", r"\u003c")


def content_policy(script: str) -> str:
    """Return the Content-Security-Policy of a page that runs only this inline script and loads nothing."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )


@cache
def bundle_script(entry: str) -> str:
    """Bundle the module `entry` of the package's assets with all modules that it imports."""
    sources: dict[str, str] = {}
    _collect(entry, sources)
    script = "\n".join(['"use strict";', "const modules = {};", *sources.values()])
    assert not re.search(r"</script|<!--", script, re.I), f"{entry} would end the page's script"
    return script


def _collect(path: str, sources: dict[str, str]) -> None:
    """Add a module to `sources` after its imports, as an immediately invoked function."""
    if path in sources:
        return
    exported: list[str] = []

    def listed(match: re.Match) -> str:
        kind, names, origin = match.groups()
        if origin is None:
            exported.extend(_pairs(names, ": ", swapped=True))
            return ""
        other = posixpath.normpath(posixpath.join(posixpath.dirname(path), origin))
        _collect(other, sources)
        if kind == "export":
            exported.extend(f"{name}: modules[{other!r}].{name}" for name in _pairs(names, ""))
            return ""
        return f"const {{ {', '.join(_pairs(names, ': '))} }} = modules[{other!r}];"

    text = _LISTED.sub(listed, _COMMENT.sub("", read_asset(path)))
    exported += _DECLARED.findall(text)
    text = _DECLARED.sub("", text)
    assert not re.search(r"^(import|export)\b", text, re.M), f"{path} imports or exports in another way"
    sources[path] = f"modules[{path!r}] = (() => {{\n{text}\nreturn {{ {', '.join(exported)} }};\n}})();"


def _pairs(names: str, joint: str, swapped: bool = False) -> list[str]:
    """Return the names of a list; names with an alias become "name: alias", or the reverse if `swapped`."""
    pairs = []
    for name in filter(None, map(str.strip, names.split(","))):
        own, _, alias = (part.strip() for part in name.partition(" as "))
        pairs.append(own if not alias else f"{alias}{joint}{own}" if swapped else f"{own}{joint}{alias}")
    return pairs


def assemble(template: str, entry: str, styles: Sequence[str], texts: Mapping[str, str]) -> str:
    """Assemble a self-contained page.

    Args:
        template: HTML template of the assets, with placeholders `/* name */`.
        entry: Module to bundle as the script.
        styles: Style sheets of the assets.
        texts: HTML of the other placeholders, by name.
    """
    script, style = bundle_script(entry), "\n".join(map(read_asset, styles))
    known = {"script": script, "policy": content_policy(script), "style": style, **texts}
    return _PLACE.sub(lambda match: known[match[1]], read_asset(template))
