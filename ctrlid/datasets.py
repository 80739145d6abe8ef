"""Public measured records, fetched by address and checksum, as SI records."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pooch
from scipy import io

from .data import Record
from .errors import CtrlidError

FOLDER_VARIABLE = "CTRLID_DATA_DIR"


@dataclass(frozen=True)
class Source:
    """Where a public file comes from, and on what terms."""

    file: str  # in the local folder
    repository: str
    commit: str
    path: str  # in the repository
    sha256: str
    terms: str

    @property
    def address(self) -> str:
        """The public address of the file."""
        return f"https://raw.githubusercontent.com/{self.repository}/{self.commit}/{self.path}"


def _emps_source(file: str, sha256: str) -> Source:
    return Source(
        f"emps/{file}", "forgi86/sysid-neural-continuous",
        "956aa7ecd73061b0321c6f6098d74c9e4a7ce67a", f"examples/EMPS/data/{file}", sha256,
        "public benchmark; cite Janot, Gautier, Brunot (2019), Data Set and Reference Models of "
        "EMPS",
    )  # fmt: skip


def _inteco_source(file: str, sha256: str) -> Source:
    return Source(
        f"inteco/{file}", "MPKowalczyk/Magnetic_levitation",
        "2fe9575ce557f9e2e9461efeca98d189162c28c4", f"Matlab/{file}", sha256, "no licence stated",
    )  # fmt: skip


def _servo_source(file: str, sha256: str) -> Source:
    return Source(
        f"servo/{file}", "helonayala/bab_datasets", "584399a037c9a8f2793b51cca76ce7cd9823c2d0",
        f"data/{file}", sha256, "no licence stated",
    )  # fmt: skip


EMPS = _emps_source(
    "DATA_EMPS.mat", "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e"
)
EMPS_PULSES = _emps_source(
    "DATA_EMPS_PULSES.mat", "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704"
)
INTECO_PID = _inteco_source(
    "data_PID_step.mat", "88ea9852dbb14d5f7ff9d3dda3476ff50f5bff34de2748238ce3e92967cf86b4"
)
INTECO_COIL = _inteco_source(
    "data_stepcon.mat", "18e19ab2dd1b198603d2f8052fa169f9b2eb6e9692536f582a24c6a3891e018f"
)
MAGNETOSHIELD = Source(
    "magnetoshield/MagnetoShield_ID_Data.mat", "gergelytakacs/AutomationShield",
    "bc0778f97a156d4ea5158725e09068d438e59a39",
    "matlab/examples/MagnetoShield/MagnetoShield_ID_Data.mat",
    "0d268ef80702641b7e7c125b447dab4bd7e797e89ea62880a2f5eb437e895cb7", "CC BY-NC-ND 4.0",
)  # fmt: skip
SERVO_STEPS = _servo_source(
    "03_random_steps_01.mat", "c7c104e0e9406f22b9567beb73f914085991a3628e4b7ede422507b7a65b32bd"
)
SERVO_SINE = _servo_source(
    "04_swept_sine.mat", "9b4c7e08602acaa8b72ff1fbfdf38d08bf9e0466fd7bea7102916b1f8f6d3fac"
)
TANKS = Source(
    "tanks/dataBenchmark.mat", "forgi86/sysid-neural-unc",
    "4652931922a0a482babe6395057c54c8ceafda7e",
    "examples/CTS/data/CascadedTanksFiles/dataBenchmark.mat",
    "cb2f88d4388be4d3f2a24c6402fba804976aac5f2e1f26cda59ea0a38d016eab",
    "public benchmark; cite Schoukens, Mattson, Wigren, Noël (2016)",
)  # fmt: skip


def _channel(table: Any, key: str, column: int = 0) -> Any:
    values = np.asarray(table[key], dtype=float)
    return values.ravel() if 1 in values.shape else values[:, column]


def _emps(table: Any) -> Record:
    extra = {"pulses": _channel(table, "pulses_N")} if "pulses_N" in table else {}
    return Record(
        r=_channel(table, "qg"), u=_channel(table, "vir"), y=_channel(table, "qm"), dt=1e-3,
        extra=extra, units={"r": "m", "u": "V", "y": "m"},
        names={"r": "reference", "u": "drive voltage", "y": "position"},
    )  # fmt: skip


def _inteco_pid(table: Any) -> Record:
    time = _channel(table, "sim_time")
    # The ball hits both stops at first, and swings out of the controlled range twice later.
    valid = (time >= 2.0) & ~((time >= 10.0) & (time < 12.0)) & ~((time >= 18.0) & (time < 20.0))
    return Record(
        r=_channel(table, "sim_pos", 0), u=_channel(table, "sim_con"),
        y=_channel(table, "sim_pos", 1), dt=1e-3, valid=valid, start=float(time[0]),
        extra={"current": _channel(table, "sim_cur")},
        units={"r": "m", "u": "1", "y": "m", "current": "A"},
        names={"r": "reference", "u": "duty", "y": "gap"},
    )  # fmt: skip


def _inteco_coil(table: Any) -> Record:
    return Record(
        u=_channel(table, "sim_con"), y=_channel(table, "sim_cur"), dt=1e-3,
        extra={"gap": _channel(table, "sim_pos", 1)}, units={"u": "1", "y": "A", "gap": "m"},
        names={"u": "duty", "y": "current"},
    )  # fmt: skip


def _magnetoshield(table: Any) -> list[Record]:
    whole = np.asarray(table["result"], dtype=float)
    return [
        Record(
            u=part[:, 1], y=part[:, 0] * 1e-3, dt=3.25e-3, extra={"current": part[:, 2] * 1e-3},
            units={"u": "V", "y": "m", "current": "A"},
            names={"u": "solenoid voltage", "y": "gap"}, name=f"set-point {k + 1}",
        )
        for k, part in enumerate(np.split(whole, 5))
    ]  # fmt: skip


def _servo(table: Any) -> Record:
    return Record(
        r=_channel(table, "ref"), u=_channel(table, "u"), y=_channel(table, "y"), dt=1e-3,
        extra={"filtered": _channel(table, "yf")},
        units={"r": "V", "u": "V", "y": "V", "filtered": "V"},
        names={"r": "reference", "u": "drive voltage", "y": "angle"},
    )  # fmt: skip


def _tanks(which: str) -> Callable[[Any], Record]:
    def read(table: Any) -> Record:
        return Record(
            u=_channel(table, "u" + which), y=_channel(table, "y" + which),
            dt=float(_channel(table, "Ts")[0]), units={"u": "V", "y": "V"},
            names={"u": "pump voltage", "y": "level sensor"},
        )  # fmt: skip

    return read


_CATALOGUE: dict[str, tuple[Source, Callable[[Any], Any], str]] = {
    "emps": (EMPS, _emps, "electro-mechanical positioning system in closed loop, one integrator"),
    "emps_pulses": (EMPS_PULSES, _emps, "the same with force pulses added to the drive"),
    "inteco_pid_step": (INTECO_PID, _inteco_pid,
                        "magnetic levitation under PID control, steps between 8 and 14 mm"),
    "inteco_coil_step": (INTECO_COIL, _inteco_coil,
                         "its coil alone: current after a step of the duty, the ball at rest"),
    "magnetoshield_r3": (MAGNETOSHIELD, _magnetoshield,
                         "levitated permanent magnet with dither, a list of five set-points"),
    "servo_random_steps": (SERVO_STEPS, _servo, "servo of a ball-and-beam rig, random steps"),
    "servo_swept_sine": (SERVO_SINE, _servo, "servo of a ball-and-beam rig, swept sine"),
    "tanks_estimation": (TANKS, _tanks("Est"), "cascaded tanks in open loop, estimation data"),
    "tanks_validation": (TANKS, _tanks("Val"), "cascaded tanks in open loop, validation data"),
}  # fmt: skip


def names() -> tuple[str, ...]:
    """Return the names of the records that `load` knows.

    Returns
    -------
    tuple of str
        The names.

    Examples
    --------
    >>> import ctrlid as cid
    >>> "emps" in cid.datasets.names()
    True
    """
    return tuple(_CATALOGUE)


def _entry(name: str) -> tuple[Source, Callable[[Any], Any], str]:
    if name not in _CATALOGUE:
        raise CtrlidError(f"there is no dataset {name!r}; there are {', '.join(_CATALOGUE)}")
    return _CATALOGUE[name]


def describe(name: str) -> str:
    """Return what a record is, where it comes from and on what terms.

    Parameters
    ----------
    name : str
        One of `names`.

    Returns
    -------
    str
        The description.

    Raises
    ------
    CtrlidError
        If there is no such record.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.datasets.describe("tanks_validation"))
    cascaded tanks in open loop, validation data.
    Source: https://raw.githubusercontent.com/forgi86/sysid-neural-unc/...
    Terms: public benchmark; cite Schoukens, Mattson, Wigren, Noël (2016)
    """
    source, _, text = _entry(name)
    return f"{text}.\nSource: {source.address}\nTerms: {source.terms}"


def load(name: str) -> Any:
    """Load a public measured record.

    The file is looked for in the folder named by the environment variable ``CTRLID_DATA_DIR``, else
    fetched once from its public address and kept in the user's cache; either way its SHA-256 is
    checked. Signals are converted to SI units, and stretches that are known not to count are
    marked in `valid`.

    Parameters
    ----------
    name : str
        One of `names`.

    Returns
    -------
    Record or list of Record
        The record; ``"magnetoshield_r3"`` is a list of five, one per set-point.

    Raises
    ------
    CtrlidError
        If there is no such record, the file cannot be fetched or is not the published one.
    """
    source, read, _ = _entry(name)
    table = io.loadmat(_path(source))
    loaded = read(table)
    parts = loaded if isinstance(loaded, list) else [loaded]
    titled = [p._map(lambda s: s, name=f"{name} {p.name}".strip()) for p in parts]
    return titled if isinstance(loaded, list) else titled[0]


def _path(source: Source) -> Path:
    folder = os.environ.get(FOLDER_VARIABLE)
    if folder:
        local = Path(folder) / source.file
        if local.is_file():
            if pooch.file_hash(str(local)) != source.sha256:
                raise CtrlidError(f"{local} is not the published file (its SHA-256 differs from "
                                  f"{source.sha256}); remove it to fetch the original")  # fmt: skip
            return local
    pooch.get_logger().setLevel("ERROR")
    try:
        fetched = pooch.retrieve(
            source.address, known_hash=f"sha256:{source.sha256}", path=pooch.os_cache("ctrlid")
        )
    except Exception as reason:
        raise CtrlidError(
            f"cannot fetch {source.address} ({type(reason).__name__}). Connect to the network, or "
            f"put the file at {source.file} in a folder and name that folder in the environment "
            f"variable {FOLDER_VARIABLE}"
        ) from reason
    return Path(fetched)
