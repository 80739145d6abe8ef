"""The examples keep their promises: the paper's claims, and the two real levitations."""

import runpy
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

from problems import load_script

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(autouse=True)
def _no_windows():
    import matplotlib.pyplot as plt

    mpl.use("Agg")
    yield
    plt.close("all")


def test_the_papers_experiment(capsys):
    """Equations (6) and (8), the portions and the sampling period, as the paper reports them."""
    told = runpy.run_path(str(EXAMPLES / "plot_paper_experiment.py"))
    truth = told["pole"]
    by_period = {line["period"]: line for line in told["in_loop"]}
    # Within the loop's noise: a reciprocal pair, nearly the same for different data portions.
    best = by_period[0.005]
    z = best["tied"].poles()
    assert z[0] * z[1] == pytest.approx(1.0, abs=1e-12)
    assert best["tied"].den[0][0][2] == 1.0
    assert np.ptp(best["portions"]) < 0.02
    assert not best["tied"].estimate.active
    # Plain least squares under the logger's noise finds no pole outside the unit circle, as (6).
    for line in told["in_log"][:3]:
        assert np.abs(line["free"].poles()).max() < 1
        np.testing.assert_array_equal(line["tied"].den[0][0], [1.0, -2.0, 1.0])  # as (8)
    # Faster sampling is worse, and so is slower under an analog controller.
    error = {T: abs(told["rate"](line["tied"]) - truth) for T, line in by_period.items()}
    assert error[0.001] > error[0.002] > error[0.005] < error[0.010]
    printed = capsys.readouterr().out
    assert "IS ON ITS BOUND" in printed
    assert "NO POLE OUTSIDE THE UNIT CIRCLE" in printed


@pytest.fixture
def levitations(data_dir):
    del data_dir
    return load_script("examples", "real_levitations")


def test_inteco_needs_the_current(levitations, capsys):
    """With the coil's current the pair is real and reciprocal, with the duty it is not."""
    found = levitations.inteco()
    assert 25 < found["step up, 12 mm", "current"] < 40.4
    assert 35 < found["step down, 8 mm", "current"] < 50.4
    assert found["step up, 12 mm", "duty"] == found["step down, 8 mm", "duty"] == 0.0
    assert "ON THE BOUND" in capsys.readouterr().out


def test_magnetoshield_needs_the_delay_and_the_lag(levitations):
    """One sample of delay and two more poles: the same pair at all five set-points."""
    found = levitations.magnetoshield()
    fourth = [pair for (_, order), pair in found.items() if order == 4]
    assert len(fourth) == 5
    assert all(47 < pair < 53 for pair in fourth)
    second = [pair for (_, order), pair in found.items() if order == 2]
    assert np.ptp(second) > 15


# The test before asks of the same records, and test_each.py of trends.
@pytest.mark.slow
def test_magnetoshield_is_as_fast_at_every_gap(levitations, capsys):
    """The continuous fit, free of the bias: one pair at all set-points, though the gaps differ."""
    series = levitations.set_points()
    assert np.all((series.rates > 48) & (series.rates < 52))
    assert np.all(series.rate_errors < 1)
    line = series.trend
    assert line.p_value > 0.01
    assert line.exponent - 2.6 * line.exponent_error > -0.5  # a ball's would be at -0.5
    assert "one model of all five: p = 50.0 ± 0.3" in capsys.readouterr().out


@pytest.mark.slow
def test_real_records_and_their_physics(data_dir, capsys):
    """What statics say, from gaps and currents at rest, is what the fits find in the motion."""
    del data_dir
    rigs = load_script("benchmarks", "real_records")
    series, statics = rigs.magnetoshield()
    assert np.abs(series.rates / statics - 1).max() < 0.06
    for level, poles, errors in rigs.inteco():
        expected = np.sqrt(2 * 9.81 / (level + 0.00225))
        off = np.abs(poles - [expected, -expected])
        assert np.all(off < 0.16 * expected + 3 * errors), level
    assert "the pull falls as i^2/(x + 2.2 mm)^2" in capsys.readouterr().out


def test_a_long_log_is_fitted_in_blocks(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["bench_long.py", "--samples", "1200000"])
    load_script("benchmarks", "bench_long").main()
    assert "1199998 rows" in capsys.readouterr().out


@pytest.mark.slow  # the manual executes it as well
def test_the_tutorial(capsys):
    """From a CSV file to a controller whose promise only the named effect lets it keep."""
    told = runpy.run_path(str(EXAMPLES / "plot_04_csv_to_controller.py"))
    printed = capsys.readouterr().out
    assert "SOMETHING IS MISSING" in printed
    assert "Explained. The model lacks InputDelay." in printed
    assert printed.count("the promise holds") == 2
    assert printed.count("DEGREES OF PHASE MARGIN ARE LOST") == 2
    assert told["found"].loop.parameters["K"] == pytest.approx(1.04 * 3.34e-6, rel=1e-3)
    assert told["page"].read_text("utf-8").count("<img ") >= 6
