"""Every key of a spec: in words, and as a JSON schema for editors."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any


def keys_of_a_spec() -> str:
    """docs/spec.md, which a wheel carries beside this file, and a checkout in its folder docs."""
    carried = files("orthaug.commands").joinpath("spec.md")
    page = carried if carried.is_file() else Path(__file__).parents[3] / "docs" / "spec.md"
    return page.read_text(encoding="utf-8").rstrip()


def schema_of_a_spec() -> dict[str, Any]:
    """Keys, types, limits and defaults."""
    from orthaug.commands.spec import Spec

    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Spec.model_json_schema()}
