"""Self-contained HTML pages: data, style and script in one file, under a policy that lets nothing else in."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping


def hash_source(text: str) -> str:
    """A script or style as a content security policy names it, so that it alone may run."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def script_data(facts: Mapping[str, object]) -> str:
    r"""JSON that cannot end the element it stands in, for any names in it; without characters beyond ASCII.

    Example:
        >>> script_data({"name": "</script>"})
        '{"name": "\\u003c/script\\u003e"}'
    """
    data = json.dumps(facts, allow_nan=False)
    return data.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def fill(template: str, values: Mapping[str, str]) -> str:
    """Put values into the places ``{{name}}`` in one pass, so that a value is never searched for places."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)
