"""JSON that a person can read, with the numbers that JSON does not have."""

import json
import math
from typing import Any

SPECIAL = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}  # written as texts
IN_A_LINE = 8  # numbers of an array


def numbers(data: Any) -> Any:
    """Return numbers that JSON does not have from their names, and all else as it is."""
    match data:
        case str():
            return SPECIAL.get(data, data)
        case list():
            return [numbers(v) for v in data]
        case dict():
            return {k: numbers(v) for k, v in data.items()}
    return data


def readable(value: Any, indent: int = 0) -> str:
    """Write JSON with an entry a line and the numbers of an array several in a line."""
    inner, outer = " " * (indent + 2), " " * indent
    if isinstance(value, dict) and value:
        rows = [f"{json.dumps(k, ensure_ascii=False)}: {readable(v, indent + 2)}"
                for k, v in value.items()]  # fmt: skip
        return "{\n" + ",\n".join(inner + row for row in rows) + f"\n{outer}}}"
    if isinstance(value, list) and value and any(isinstance(v, dict | list) for v in value):
        return "[\n" + ",\n".join(inner + readable(v, indent + 2) for v in value) + f"\n{outer}]"
    if isinstance(value, list) and len(value) > IN_A_LINE:
        rows = [json.dumps(value[k : k + IN_A_LINE], ensure_ascii=False)[1:-1]
                for k in range(0, len(value), IN_A_LINE)]  # fmt: skip
        return "[\n" + ",\n".join(inner + row for row in rows) + f"\n{outer}]"
    return json.dumps(value, ensure_ascii=False)
