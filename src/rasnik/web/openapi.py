"""The HTTP interface described for programs, as OpenAPI 3.1; made from the table of endpoints."""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Any

import rasnik
from rasnik.live.status import ChannelStatus
from rasnik.tracking.track import TRACK_COLUMNS
from rasnik.web.api import ENDPOINTS, Endpoint, Parameter
from rasnik.web.quantities import QUANTITIES

__all__ = ["document"]

_NUMBER = {"type": ["number", "null"], "description": "null if it is not known"}
_STRING = {"type": "string"}
_NUMBERS = {"type": "array", "items": {"type": ["number", "null"]}}


def document() -> dict[str, Any]:
    """The whole description."""
    paths: dict[str, Any] = {}
    for endpoint in ENDPOINTS:
        paths.setdefault(endpoint.path, {})[endpoint.method.lower()] = _operation(endpoint)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "rasnik",
            "version": rasnik.__version__,
            "summary": "Channels of a Rasnik station: positions, frames, recordings.",
            "license": {"name": "BSD-3-Clause", "identifier": "BSD-3-Clause"},
        },
        "security": [{"token": []}, {}],
        "paths": paths,
        "components": {
            "schemas": _schemas(),
            "securitySchemes": {
                "token": {
                    "type": "http",
                    "scheme": "bearer",
                    "description": "Needed where the server listens beyond its own machine.",
                }
            },
        },
    }


def _operation(endpoint: Endpoint) -> dict[str, Any]:
    parts = [part for part in endpoint.path.split("/") if part not in ("api", "{name}", "")]
    one = "{name}" in endpoint.path and parts == ["channels"]
    name = "-".join([endpoint.method.lower(), *(["channel"] if one else parts)])
    operation: dict[str, Any] = {"operationId": name, "summary": endpoint.summary}
    places = [_path_name()] if "{name}" in endpoint.path else []
    if endpoint.method == "GET":
        places += [_in_query(parameter) for parameter in endpoint.parameters]
    else:
        places.append(_custom_header())
        if endpoint.parameters:
            operation["requestBody"] = _body(endpoint.parameters)
    if places:
        operation["parameters"] = places
    operation["responses"] = {
        "200": {"description": "Done.", "content": _content(endpoint.schema)},
        "default": {"description": "A sentence on what is wrong.", "content": _content("Error")},
    }
    return operation


def _content(schema: str) -> dict[str, Any]:
    if "/" in schema:
        return {schema: {"schema": {"type": "string"}}}
    return {"application/json": {"schema": {"$ref": f"#/components/schemas/{schema}"}}}


def _path_name() -> dict[str, Any]:
    return {"name": "name", "in": "path", "required": True, "schema": _STRING}


def _custom_header() -> dict[str, Any]:
    return {
        "name": "X-Rasnik",
        "in": "header",
        "description": "Any value; other pages in a browser cannot send it. Not needed with a "
        "bearer token.",
        "schema": _STRING,
    }


def _in_query(parameter: Parameter) -> dict[str, Any]:
    return {
        "name": parameter.name,
        "in": "query",
        "required": parameter.default is None,
        "description": parameter.description,
        "schema": _limits(parameter),
    }


def _limits(parameter: Parameter) -> dict[str, Any]:
    known = {
        "type": parameter.kind,
        "default": parameter.default,
        "minimum": parameter.least,
        "maximum": parameter.most,
        "enum": list(parameter.choices) or None,
    }
    return {key: value for key, value in known.items() if value is not None}


def _body(parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    schema = {
        "type": "object",
        "additionalProperties": False,
        "required": [p.name for p in parameters if p.default is None],
        "properties": {p.name: {**_limits(p), "description": p.description} for p in parameters},
    }
    return {"required": True, "content": {"application/json": {"schema": schema}}}


# ------------------------------------------------------------------------- schemas


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "required": list(properties), "properties": properties}


def _schemas() -> dict[str, Any]:
    words = {"type": "array", "items": _STRING}
    curves = {f"{q.key}_{kind}": _NUMBERS for q in QUANTITIES for kind in ("min", "mean", "max")}
    rows = {c.name: {**_NUMBERS, "description": c.description} for c in TRACK_COLUMNS}
    return {
        "Error": _object(error=_STRING),
        "Health": _object(ok={"type": "boolean"}, channels={"type": "object"}),
        "Station": _object(name=_STRING, version=_STRING, folder=_STRING, channels=words),
        "Channel": _channel(),
        "ChannelList": {"type": "array", "items": {"$ref": "#/components/schemas/Channel"}},
        "Rows": _object(next={"type": "integer"}, rows=_object(**rows)),
        "History": _object(time_s=_NUMBERS, **curves),
        "Saved": _object(file=_STRING),
    }


def _channel() -> dict[str, Any]:
    """As the fields of `ChannelStatus` are typed."""
    hints = typing.get_type_hints(ChannelStatus)
    fields = {f.name: _schema_of(hints[f.name]) for f in dataclasses.fields(ChannelStatus)}
    keys = [key for q in QUANTITIES for key in (q.key, f"sigma_{q.key}")]
    fields["keep_exposure"] = {"type": ["boolean", "null"], "description": "null: not told"}
    return _object(**fields, relative=_object(**{key: _NUMBER for key in keys}))


def _schema_of(hint: Any) -> dict[str, Any]:
    plain: dict[Any, dict[str, Any]] = {
        float: _NUMBER,
        bool: {"type": "boolean"},
        int: {"type": "integer"},
        str: _STRING,
    }
    if hint in plain:
        return plain[hint]
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return {"type": "string", "enum": list(arguments)}
    if origin is tuple:
        return {"type": "array", "items": _schema_of(arguments[0])}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema_of(arguments[1])}
    if origin in (typing.Union, types.UnionType):
        return {
            "anyOf": [{"type": "null"} if a is type(None) else _schema_of(a) for a in arguments]
        }
    raise TypeError(f"no schema for {hint}")
