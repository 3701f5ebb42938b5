"""A page that lists the requests of an OpenAPI document. It loads nothing, from nowhere."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

_STYLE = """
body { font: 16px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222 }
h2 { font-size: 1.1em; margin: 2em 0 0.3em; border-top: 1px solid #ccc; padding-top: 1em }
table { border-collapse: collapse; width: 100% }
td, th { text-align: left; vertical-align: top; padding: 0.2em 1em 0.2em 0 }
code { background: #f2f2f2; padding: 0 0.2em }
"""


def page(document: Mapping[str, Any]) -> str:
    """Return the document as HTML."""
    info = document["info"]
    lines = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>{escape(info['title'])}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{escape(info['title'])} {escape(info['version'])}</h1><p>{escape(info.get('summary', ''))}</p>",
        "<p>The same for programs: <a href='/openapi.json'>openapi.json</a>. Errors are JSON: <code>error</code>.</p>",
    ]
    schemas = document["components"]["schemas"]
    for path, methods in document["paths"].items():
        for method, request in methods.items():
            lines += _request(f"{method.upper()} {path}", request, schemas)
    lines.append("<h1>Types</h1>")
    for name, schema in schemas.items():
        if not name.startswith("Body_") and "properties" in schema:
            lines += [f"<h2 id='{escape(name)}'>{escape(name)}</h2><p>{escape(schema.get('description', ''))}</p>"]
            lines += _fields(schema)
    return "\n".join([*lines, "</body></html>"])


def _request(title: str, request: Mapping[str, Any], schemas: Mapping[str, Any]) -> Iterator[str]:
    yield f"<h2><code>{escape(title)}</code></h2><p>{escape(request.get('description', ''))}</p>"
    for content in request.get("requestBody", {}).get("content", {}).values():
        yield from _fields(schemas[content["schema"]["$ref"].rpartition("/")[2]])
    yield "<table><tr><th>answer</th><th></th><th></th></tr>"
    for status, answer in request["responses"].items():
        kinds = " ".join(
            _kind(one.get("schema", {})) or escape(name) for name, one in answer.get("content", {}).items()
        )
        yield f"<tr><td>{escape(status)}</td><td>{kinds}</td><td>{escape(answer['description'])}</td></tr>"
    yield "</table>"


def _fields(schema: Mapping[str, Any]) -> Iterator[str]:
    yield "<table><tr><th>field</th><th>type</th><th></th></tr>"
    for name, field in schema["properties"].items():
        needed = "<b>needed</b> " if name in schema.get("required", ()) else ""
        default = (
            f" (else {escape(json.dumps(field['default']))})" if field.get("default") not in (None, [], "") else ""
        )
        said = escape(field.get("description", ""))
        yield f"<tr><td><code>{escape(name)}</code></td><td>{_kind(field)}</td><td>{needed}{said}{default}</td></tr>"
    yield "</table>"


def _kind(field: Mapping[str, Any]) -> str:
    """Return a type in words, with links to those of the document."""
    if "$ref" in field:
        name = escape(field["$ref"].rpartition("/")[2])
        return f"<a href='#{name}'>{name}</a>"
    if "anyOf" in field:
        return " or ".join(_kind(one) for one in field["anyOf"] if one.get("type") != "null")
    if "enum" in field:
        return ", ".join(escape(str(value)) for value in field["enum"])
    if field.get("type") == "array":
        return f"list of {_kind(field.get('items', {}))}"
    if "contentMediaType" in field or field.get("format") == "binary":
        return "file"
    return escape(str(field.get("type", "")))
