"""The diagnosis on real records: the stories assert what the literature knows."""

import runpy
from pathlib import Path

import matplotlib as mpl
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


RIGS = ("emps", "inteco", "magnetoshield", "servo", "silverbox", "tanks")


@pytest.mark.slow
@pytest.mark.parametrize("name", [f"real_{rig}" for rig in RIGS])
def test_the_story(name, data_dir, capsys):
    """Each story ends in assertions of its own; here it must also print its report."""
    del data_dir
    import matplotlib.pyplot as plt

    mpl.use("Agg")
    told = runpy.run_path(str(EXAMPLES / f"{name}.py"))
    plt.close("all")
    verdict = told["found"].verdict
    assert verdict in ("partly explained", "unknown")
    assert verdict.upper() in capsys.readouterr().out
