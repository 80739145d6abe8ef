"""The numbers of the diagnosis in the manual: ``|gate|`` in a sentence, all of them as a table."""

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList

from ctrlid.diagnosis.thresholds import THRESHOLD

HEAD = ("number", "value", "of what", "kind", "reason")


def write_value(number):
    """Write a number, or several, as a reader would."""
    if isinstance(number, tuple):
        return ", ".join(map(write_value, number))
    return f"{number:,}".replace(",", " ") if isinstance(number, int) else f"{number:g}"


def list_substitutions():
    """Return a substitution for each number of the table, by its name."""
    lines = [f".. |{t.name}| replace:: {write_value(t.value)}" for t in THRESHOLD.table()]
    return "\n" + "\n".join(lines) + "\n"


class ThresholdsTable(Directive):
    """All numbers that decide a name, as `ctrlid.diagnosis.thresholds` has them."""

    def run(self):
        """Return the table."""
        lines = [".. list-table::", "   :header-rows: 1", "   :widths: 22 12 18 10 38", ""]
        rows = [HEAD]
        for t in THRESHOLD.table():
            source = f" ({t.source})" if t.source else ""
            rows.append((f"``{t.name}``", write_value(t.value), t.unit, t.kind, t.reason + source))
        for first, *rest in rows:
            lines.append(f"   * - {first}")
            lines += [f"     - {cell}" for cell in rest]
        place = nodes.Element()
        self.state.nested_parse(StringList(lines, source="thresholds"), self.content_offset, place)
        return place.children


def setup(app):
    """Register the directive."""
    app.add_directive("thresholds", ThresholdsTable)
    return {"parallel_read_safe": True}
