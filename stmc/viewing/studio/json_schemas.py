"""JSON Schema of what requests and responses hold: of records of settings, of typed dictionaries, and of their types.

A schema derives from the hints, help, limits and choices by which the server reads and checks a value. This module
knows types; the studio's own types come in as a table.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NotRequired, Union, get_args, get_origin, get_type_hints, is_typeddict

from stmc.settings.records import FieldInfo

Schema = dict[str, Any]
"""A JSON Schema, draft 2020-12, as OpenAPI 3.1 uses it."""

_PLAIN: Mapping[Any, str] = {str: "string", bool: "boolean", int: "integer", float: "number", NoneType: "null"}
_LIMITS = {"at_least": "minimum", "above": "exclusiveMinimum", "at_most": "maximum", "below": "exclusiveMaximum"}


@dataclasses.dataclass
class Schemas:
    """Schemas of types; those with a name are collected in `components`, and referred to."""

    own: Mapping[Any, Callable[[Schemas], Schema | None]]
    """Functions that return the schema of a type, or None for one that JSON cannot express."""
    components: dict[str, Schema] = dataclasses.field(default_factory=dict)

    def of(self, hint: Any, info: FieldInfo | None = None) -> Schema | None:
        """Return the schema of a type, or None if JSON cannot express it.

        Args:
            hint: Type.
            info: Help, limits and choices.
        """
        schema = self._of(hint, info or FieldInfo(""))
        if schema is not None and info is not None:
            help = f"{info.help} ({info.unit})" if info.unit else info.help
            schema = schema | ({"description": help} if help else {})
        return schema

    def named(self, name: str, make: Callable[[], Schema]) -> Schema:
        """Return a reference to a component, which is made on the first call."""
        if name not in self.components:
            self.components[name] = {}  # for components that contain themselves
            self.components[name] = make()
        return {"$ref": f"#/components/schemas/{name}"}

    def of_record(self, record: type, without: Sequence[str] = ()) -> Schema:
        """Return the schema of a record's JSON object; fields that JSON cannot express are omitted.

        Args:
            record: Dataclass.
            without: Fields to omit.
        """
        hints, properties, required = get_type_hints(record), {}, []
        for field in dataclasses.fields(record):
            schema = self.of(hints[field.name], field.metadata.get("info", FieldInfo("")))
            if field.name in without or schema is None or "rest" in field.metadata:
                continue
            properties[field.name] = schema | _of_default(field.default) | _of_length(schema, field.metadata)
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                required.append(field.name)
        return _object(properties, required)

    def of_arguments(self, function: Callable[..., Any]) -> Schema:
        """Return the schema of a JSON object of a function's arguments that have names."""
        hints, properties, required = get_type_hints(function), {}, []
        for name, parameter in inspect.signature(function).parameters.items():
            schema = None if parameter.kind is inspect.Parameter.POSITIONAL_ONLY else self.of(hints[name])
            if schema is not None:
                properties[name] = schema | _of_default(parameter.default)
                required += [name] if parameter.default is inspect.Parameter.empty else []
        return _object(properties, required)

    def _of(self, hint: Any, info: FieldInfo) -> Schema | None:
        origin, arguments = get_origin(hint), get_args(hint)
        if hint in self.own:
            return self.own[hint](self)
        if hint in _PLAIN:
            limits = {_LIMITS[name]: limit for name, limit in info.limits} if hint in (int, float) else {}
            choices = {"enum": list(info.choices)} if info.choices and hint is str else {}
            return {"type": _PLAIN[hint]} | limits | choices
        if origin is Annotated:
            schema = self._of(arguments[0], info)
            return None if schema is None else schema | {"description": arguments[1]}
        if origin is NotRequired:
            return self._of(arguments[0], info)
        if origin is Literal:
            return {"enum": list(arguments)}
        if origin in (Union, UnionType):
            return self._of_union(arguments, info)
        if is_typeddict(hint):
            return self.named(hint.__name__, lambda: self._of_dictionary(hint))
        if isinstance(origin or hint, type) and issubclass(origin or hint, Mapping):
            values = self._of(arguments[1], FieldInfo("")) if arguments else None
            return {"type": "object"} | ({"additionalProperties": values} if values else {})
        if isinstance(origin, type) and issubclass(origin, Sequence):
            items = self._of(arguments[0], info)
            return None if items is None else {"type": "array", "items": items}
        return None

    def _of_union(self, members: Sequence[Any], info: FieldInfo) -> Schema | None:
        members = [each for each in members if not (each is int and float in members)]
        schemas = [schema for schema in (self._of(each, info) for each in members) if schema is not None]
        if schemas == [{"type": "null"}] or not schemas:
            return None
        if len(schemas) == 2 and {"type": "null"} in schemas and "enum" not in schemas[0] and "type" in schemas[0]:
            return schemas[0] | {"type": [schemas[0]["type"], "null"]}
        return schemas[0] if len(schemas) == 1 else {"anyOf": schemas}

    def _of_dictionary(self, hint: Any) -> Schema:
        hints = get_type_hints(hint, include_extras=True)
        properties = {name: self.of(each) for name, each in hints.items()}
        required = [name for name, each in hints.items() if get_origin(each) is not NotRequired]
        description = {"description": inspect.cleandoc(hint.__doc__)} if hint.__doc__ else {}
        return _object({name: schema for name, schema in properties.items() if schema}, required) | description


def _object(properties: Mapping[str, Schema], required: Sequence[str]) -> Schema:
    schema = {"type": "object", "properties": dict(properties), "additionalProperties": False}
    return schema | ({"required": list(required)} if required else {})


def _of_default(default: Any) -> Schema:
    if isinstance(default, (bool, int, float, str)):
        return {"default": default}
    return {"default": list(default)} if isinstance(default, tuple) and default else {}


def _of_length(schema: Schema, metadata: Mapping[str, Any]) -> Schema:
    if "length" not in metadata:
        return {}
    names = ("minItems", "maxItems") if schema.get("type") == "array" else ("minLength", "maxLength")
    return dict(zip(names, metadata["length"], strict=True))
