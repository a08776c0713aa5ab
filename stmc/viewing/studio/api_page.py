"""A page about the API, made of its OpenAPI document: it loads nothing, and shows examples for curl.

This module knows OpenAPI documents; it knows no operations.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterable, Mapping
from importlib.resources import files
from string import Template
from typing import Any

_TOKEN = "$(cat ~/.stmc/studio/api_token)"
"""The token in a shell, with the studio's default folder."""

_UNITS = {"minLength": "at least {} letters", "maxLength": "at most {:,} letters", "minItems": "at least {} items",
          "maxItems": "at most {:,} items", "minimum": "at least {:g}", "exclusiveMinimum": "above {:g}",
          "maximum": "at most {:,g}", "exclusiveMaximum": "below {:,g}"}  # fmt: skip
"""Bounds of a JSON Schema in words."""


def render_api(document: Mapping[str, Any], address: str) -> str:
    """Render the page.

    Args:
        document: OpenAPI document.
        address: Address of the server, such as "http://127.0.0.1:8686", for the examples.
    """
    operations = [
        (method.upper(), path, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]
    objects = document["components"]["schemas"]
    body = [f"<h1>{_text(document['info']['title'])}: API</h1>", *_introduction(document, address), "<nav>"]
    body += [
        f'<a href="#{each["operationId"]}"><span class="method">{method}</span> <code>{_text(path)}</code> '
        f"{_text(each['summary'])}</a>"
        for method, path, each in operations
    ]
    body.append("</nav>")
    for tag in document["tags"]:
        body.append(f"<h2>{_text(tag['name'])}</h2>")
        for method, path, operation in operations:
            if tag["name"] in operation["tags"]:
                body += _operation(method, path, operation, address, objects)
    body.append("<h2>Objects</h2>")
    for name, schema in objects.items():
        body += [f'<h3 id="{name}">{name}</h3>', *_schema(schema)]
    page = (files("stmc") / "assets" / "api" / "page.html").read_text("utf-8")
    return Template(page).substitute(title=f"{_text(document['info']['title'])}: API", body="\n".join(body))


def _introduction(document: Mapping[str, Any], address: str) -> list[str]:
    steps = [
        f'curl -H "Authorization: Bearer {_TOKEN}" {address}/api/model',
        f"curl -O {address}/api/client.py && python client.py 'walk forwards # 0 # 4' walk.glb",
    ]
    files = "".join(
        f'<li><a href="{path}">{path}</a>: {text}</li>'
        for path, text in (
            ("/api/openapi.json", "this page for programs, OpenAPI 3.1"),
            ("/api/client.py", "an example client in Python"),
            ("/api/blender_addon.py", "an add-on for Blender"),
        )
    )
    about = [f"<p>{_prose(part)}</p>" for part in document["info"]["description"].split("\n\n")]
    return [*about, f"<pre>{_text(chr(10).join(steps))}</pre>", f"<ul>{files}</ul>"]


def _operation(
    method: str, path: str, operation: Mapping[str, Any], address: str, objects: Mapping[str, Any]
) -> Iterable[str]:
    yield f'<h3 id="{operation["operationId"]}"><span class="method">{method}</span> <code>{_text(path)}</code></h3>'
    yield f"<p>{_text(operation['summary'])}. {_prose(operation.get('description', ''))}</p>"
    yield f"<pre>{_text(_curl(method, path, operation, address))}</pre>"
    if operation.get("parameters"):
        yield "<h4>Parameters</h4>"
        yield _table((each["name"], _words(_schema_of(each)), each["description"]) for each in operation["parameters"])
    body = operation.get("requestBody", {})
    content = body.get("content", {}).get("application/json")
    if body:
        yield f"<h4>Body: {'a JSON object' if content else _text(body['description'])}</h4>"
    if content:
        yield _fields(objects[content["schema"]["$ref"].rsplit("/", 1)[-1]])
    yield "<h4>Responses</h4>"
    yield _table((status, _content(each["content"]), each["description"]) for status, each in _responses(operation))


def _responses(operation: Mapping[str, Any]) -> Iterable[tuple[str, Mapping[str, Any]]]:
    return ((status, each) for status, each in operation["responses"].items() if status != "default")


def _content(content: Mapping[str, Any]) -> str:
    """Return the media types or the object of a response, in words."""
    words = []
    for media_type, each in content.items():
        events = each.get("x-events")
        if events:
            words += [f"<code>{name}</code>: {_words(schema)}" for name, schema in events.items()]
        else:
            words.append(_words(each["schema"]) if "schema" in each else f"<code>{_text(media_type)}</code>")
    return ", ".join(words)


def _curl(method: str, path: str, operation: Mapping[str, Any], address: str) -> str:
    """Return a request for a shell."""
    stream = " -N" if any("text/event-stream" in each["content"] for _, each in _responses(operation)) else ""
    named = path.replace("{name}", "NAME").replace("{kind}", "glb")
    words = [f"curl{stream}{'' if method == 'GET' else f' -X {method}'} {address}{named}"]
    if "security" not in operation:
        words.append(f'-H "Authorization: Bearer {_TOKEN}"')
    body = operation.get("requestBody", {}).get("content", {})
    if "application/json" in body:
        example = json.dumps(body["application/json"]["example"]).replace("'", "'\\''")
        words.append(f"-d '{example}'")
    elif body:
        words.append("-H 'X-Filename: walk.bvh' --data-binary @walk.bvh")
    return " \\\n  ".join(words)


def _schema_of(parameter: Mapping[str, Any]) -> Mapping[str, Any]:
    return parameter["schema"] if "schema" in parameter else parameter["content"]["application/json"]["schema"]


def _schema(schema: Mapping[str, Any]) -> Iterable[str]:
    """Describe a component."""
    if "description" in schema:
        yield f"<p>{_prose(schema['description'])}</p>"
    variants = schema.get("anyOf") or schema.get("oneOf")
    if variants:
        for each in variants:
            yield from _schema(each) if "properties" in each else [f"<p>{_words(each)}</p>"]
    elif "properties" in schema:
        yield _fields(schema)
    else:
        yield f"<p>{_words(schema)}</p>"


def _fields(schema: Mapping[str, Any]) -> str:
    required = schema.get("required", [])
    rows = [
        (name, _words(each), _note(each, name in required), _inner(each)) for name, each in schema["properties"].items()
    ]
    return _table((name, words + inner, note) for name, words, note, inner in rows)


def _inner(schema: Mapping[str, Any]) -> str:
    """Return the fields of an object within an object."""
    inner = schema.get("items", schema)
    return _fields(inner) if inner.get("properties") else ""


def _note(schema: Mapping[str, Any], required: bool) -> str:
    default = f"; {json.dumps(schema['default'])} by default" if "default" in schema else ""
    return f"{schema.get('description', '')}{'; required' if required else default}".lstrip("; ")


def _words(schema: Mapping[str, Any]) -> str:
    """Return a type with its bounds, in words."""
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[-1]
        return f'<a href="#{name}">{name}</a>'
    variants = schema.get("anyOf") or schema.get("oneOf")
    if variants:
        return " or ".join(map(_words, variants))
    if "enum" in schema:
        return "one of " + ", ".join(f"<code>{_text(str(each))}</code>" for each in schema["enum"])
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    bounds = [form.format(schema[name]) for name, form in _UNITS.items() if name in schema]
    words = " or ".join("list" if kind == "array" else kind for kind in kinds)
    if "items" in schema and not schema["items"].get("properties"):
        words += f" of {_words(schema['items'])}"
    return f"{words} ({', '.join(bounds)})" if bounds else words


def _table(rows: Iterable[tuple[str, str, str]]) -> str:
    """Return a table of names, types (HTML) and notes."""
    cells = (f"<tr><td><code>{_text(name)}</code><td>{kind}<td>{_prose(note)}" for name, kind, note in rows)
    return f"<table>{''.join(cells)}</table>"


def _text(text: str) -> str:
    return html.escape(text)


def _prose(text: str) -> str:
    """Return a text whose words in backticks are code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", _text(text))
