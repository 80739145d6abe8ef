"""What several test files share."""

import os
import sys
import tracemalloc
from pathlib import Path

import pytest

from ctrlid._base import rounding

# A warning of numpy is an error here, so that numbers that fail are found.
rounding.HANDLING |= {"divide": "warn", "over": "warn", "invalid": "warn"}


def pytest_collection_modifyitems(config, items):
    """Leave slow tests to those who ask for them with -m."""
    if not config.option.markexpr:
        config.hook.pytest_deselected(items=[i for i in items if i.get_closest_marker("slow")])
        items[:] = [i for i in items if not i.get_closest_marker("slow")]


@pytest.fixture(autouse=True)
def close_pictures():
    """Close the figures of a test: pyplot keeps them for plt.show(), and warns of more than 20."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture(autouse=True)
def leave_no_tracing():
    """Refuse a test that leaves memory tracing on, which makes all later ones four times slower."""
    yield
    left_on = tracemalloc.is_tracing()
    tracemalloc.stop()
    assert not left_on, "call tracemalloc.stop()"


@pytest.fixture
def data_dir(monkeypatch):
    """Return the folder of real measured files, and let `datasets.load` look there first.

    No such file is part of the project; a checkout may have them in a folder next to it.
    """
    beside = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CTRLID_DATA_DIR", beside))
    if not folder.is_dir():
        pytest.skip(f"needs the measured files: no folder {folder}; set CTRLID_DATA_DIR to theirs")
    monkeypatch.setenv("CTRLID_DATA_DIR", str(folder))
    return folder
