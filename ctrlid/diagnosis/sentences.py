"""The verdict in one sentence or two."""

from collections.abc import Sequence

from .._base.text import chance, number
from .omnibus import Omnibus
from .result import Disturbance, Finding, Gap, Place, Verdict


def conclusion(
    verdict: Verdict, findings: Sequence[Finding], gap: Gap, disturbance: Disturbance,
    after: Omnibus, where: Sequence[Place], loose: str = "",
) -> str:  # fmt: skip
    """Return the verdict with what it rests on.

    Parameters
    ----------
    verdict : str
        The verdict.
    findings : sequence of Finding
        The effects found.
    gap : Gap
        The gap.
    disturbance : Disturbance
        The random forces.
    after : Omnibus
        The tests of what is left.
    where : sequence of Place
        Where the disagreement sits.
    loose : str, optional
        Why effects that leave nothing but noise may yet be no explanation.

    Returns
    -------
    str
        One to three sentences.
    """
    names = " and ".join(" or ".join(f.names) for f in findings)
    name, p = after.worst
    why = f"the test of {name} fails ({chance(p)})"
    if after.passed:
        why = "on data kept back the gap stays well above the noise floor"
        if gap.after > gap.given:
            why = "on data kept back the gap is wider than that of the model as given"
    were, them = ("were", "them") if len(findings) > 1 else ("was", "it")
    if verdict == "nothing missing":
        text = "At the sensitivity of this record, what is left is noise."
    elif verdict == "explained":
        text = f"Missing {were} {names}; with {them}, what is left is noise."
    elif verdict == "partly explained" and after.passed and loose:
        text = f"With {names} what is left is noise; but {loose}."
    elif verdict == "partly explained":
        verb = "explain" if len(findings) > 1 else "explains"
        text = (f"{names} {verb} part of the gap. Something else remains that no known effect "
                f"accounts for: {why}.")  # fmt: skip
    else:
        text = f"Something is missing, but none of the known effects accounts for it: {why}."
    left = [w for w in where if w.p_after < 1e-4]
    if left and verdict in ("partly explained", "unknown"):
        text += f" It shows along {' and '.join(w.axis for w in left[:2])}."
    if disturbance.large:
        kind = "A random force"
        if disturbance.coloured:
            kind = (f"A slowly varying random force of {number(disturbance.coloured, 2)} with a "
                    f"time constant of {number(disturbance.time_constant, 2)} s")  # fmt: skip
        text += (f" {kind} makes {100 * disturbance.share:.0f} % of the noise floor's variance: "
                 "it is counted as noise here, and may hide a cause of its own.")  # fmt: skip
    return text
