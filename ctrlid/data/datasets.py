"""Public measured records, fetched by address and checksum, as SI records."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base.arguments import check_arguments
from .._base.errors import CtrlidError
from .record import Record

FOLDER_VARIABLE = "CTRLID_DATA_DIR"


@dataclass(frozen=True)
class Source:
    """Where a public file comes from, and on what terms."""

    # Path of the file in the local folder.
    file: str
    repository: str
    commit: str
    # Path of the file in the repository.
    path: str
    sha256: str
    terms: str
    # A file that holds several published ones, renamed and not otherwise changed, is not published
    # itself: `path` is their folder, and these are their names.
    originals: tuple[str, ...] = ()

    @property
    def address(self) -> str:
        """The public address of the file, or of the folder of what it was made of."""
        if self.originals:
            return f"https://github.com/{self.repository}/tree/{self.commit}/{self.path}"
        return f"https://raw.githubusercontent.com/{self.repository}/{self.commit}/{self.path}"


def _make_emps_source(file: str, sha256: str) -> Source:
    return Source(
        f"emps/{file}", "forgi86/sysid-neural-continuous",
        "956aa7ecd73061b0321c6f6098d74c9e4a7ce67a", f"examples/EMPS/data/{file}", sha256,
        "public benchmark; cite Janot, Gautier, Brunot (2019), Data Set and Reference Models of "
        "EMPS",
    )  # fmt: skip


def _make_inteco_source(file: str, sha256: str) -> Source:
    return Source(
        f"inteco/{file}", "MPKowalczyk/Magnetic_levitation",
        "2fe9575ce557f9e2e9461efeca98d189162c28c4", f"Matlab/{file}", sha256, "no licence stated",
    )  # fmt: skip


def _make_servo_source(file: str, sha256: str) -> Source:
    return Source(
        f"servo/{file}", "helonayala/bab_datasets", "584399a037c9a8f2793b51cca76ce7cd9823c2d0",
        f"data/{file}", sha256, "no licence stated",
    )  # fmt: skip


EMPS = _make_emps_source(
    "DATA_EMPS.mat", "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e"
)
EMPS_PULSES = _make_emps_source(
    "DATA_EMPS_PULSES.mat", "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704"
)
INTECO_PID = _make_inteco_source(
    "data_PID_step.mat", "88ea9852dbb14d5f7ff9d3dda3476ff50f5bff34de2748238ce3e92967cf86b4"
)
INTECO_COIL = _make_inteco_source(
    "data_stepcon.mat", "18e19ab2dd1b198603d2f8052fa169f9b2eb6e9692536f582a24c6a3891e018f"
)
MAGNETOSHIELD = Source(
    "magnetoshield/MagnetoShield_ID_Data.mat", "gergelytakacs/AutomationShield",
    "bc0778f97a156d4ea5158725e09068d438e59a39",
    "matlab/examples/MagnetoShield/MagnetoShield_ID_Data.mat",
    "0d268ef80702641b7e7c125b447dab4bd7e797e89ea62880a2f5eb437e895cb7", "CC BY-NC-ND 4.0",
)  # fmt: skip
SERVO_STEPS = _make_servo_source(
    "03_random_steps_01.mat", "c7c104e0e9406f22b9567beb73f914085991a3628e4b7ede422507b7a65b32bd"
)
SERVO_SINE = _make_servo_source(
    "04_swept_sine.mat", "9b4c7e08602acaa8b72ff1fbfdf38d08bf9e0466fd7bea7102916b1f8f6d3fac"
)
SILVERBOX = Source(
    "silverbox/SNLS80mV.mat", "biaslab/nsi-silverbox", "728f07e4539d4f7da76a4778b52a756260b488ac",
    "data/Silverbox/SNLS80mV.mat",
    "5c7413a52255af0cb4e2f93fb6903beb92b08965ba1e6ad0a6ffedfed8477ed4",
    "public benchmark; cite Wigren and Schoukens (2013), Three free data sets",
)  # fmt: skip
TANKS = Source(
    "tanks/dataBenchmark.mat", "forgi86/sysid-neural-unc",
    "4652931922a0a482babe6395057c54c8ceafda7e",
    "examples/CTS/data/CascadedTanksFiles/dataBenchmark.mat",
    "cb2f88d4388be4d3f2a24c6402fba804976aac5f2e1f26cda59ea0a38d016eab",
    "public benchmark; cite Schoukens, Mattson, Wigren, Noël (2016)",
)  # fmt: skip


_DECAR = "decargroup/closed_loop_koopman", "0b64a62e7f302441ce3580143a44d9d87c83532c"
QUBE_ESTIMATION = Source(
    "qube_furuta/qube_estim.npz", *_DECAR, "dataset/controller_20230828",
    "f202312be19d9f25d349109f8bec64560da91009573b651027505c6dacaf6318", "MIT, (c) 2023 DECAR",
    ("qube_20230828T161408_751_866_301.csv", "qube_20230828T161843_650_565_746.csv",
     "qube_20230828T162549_043_857_715.csv"),
)  # fmt: skip
QUBE_VALIDATION = Source(
    "qube_furuta/qube_valid.npz", *_DECAR, "dataset/controller_20230828",
    "f57066ba254d680baa54f64fa9d01e7db25ae6ee09108048b23f0b96521c393b", "MIT, (c) 2023 DECAR",
    ("qube_20230828T163141_187_473_481.csv", "qube_20230828T163558_031_071_138.csv"),
)  # fmt: skip


def _make_ip02_source(file: str, sha256: str) -> Source:
    return Source(
        f"ip02_cartpole/{file}", "dfki-ric-underactuated-lab/robust_codesign",
        "fb4dbdd855ae4b8ba6c3f0a596ff40b3d6d51935", f"results/cart_pole/realExperiments/{file}",
        sha256, "BSD-3-Clause, (c) 2024 DFKI",
    )  # fmt: skip


IP02_RTC = _make_ip02_source(
    "167332rtc.csv", "8074c448235d7cc18340956441d110dc4b5c287ebf73c9bae2f60d8bf81291fc"
)
IP02_DIRTRAN = _make_ip02_source(
    "167332dirtran.csv", "ff98e6d32a2c27920537e19d42d2f9499685bd9fb7048b6db6d415896d62f7e0"
)
PENDUBOT = Source(
    "dfki_double_pendulum/pendubot_175617.npz", "dfki-ric-underactuated-lab/double_pendulum",
    "1e8544e67f3da72a51ee52fbbb278e131ce2a43f",
    "data/experiment_records/design_A.0/20220819/175617-pendubot_tvlqr_lqr_VIDEO",
    "68dd9bbc6873fcf68d69aca0f147cc78930bfba0a9e93a8a55a19205043f11f9",
    "BSD-3-Clause, (c) 2022 DFKI", ("trajectory.csv",),
)  # fmt: skip


def _read_channel(table: Any, key: str, column: int = 0) -> Any:
    values = np.asarray(table[key], dtype=float)
    return values.ravel() if 1 in values.shape else values[:, column]


def _read_emps(table: Any) -> Record:
    extra = {"pulses": _read_channel(table, "pulses_N")} if "pulses_N" in table else {}
    return Record(
        r=_read_channel(table, "qg"),
        u=_read_channel(table, "vir"),
        y=_read_channel(table, "qm"),
        dt=1e-3,
        extra=extra,
        units={"r": "m", "u": "V", "y": "m", **dict.fromkeys(extra, "V")},
        names={"r": "reference", "u": "drive voltage", "y": "position"},
    )


def _read_inteco_pid(table: Any) -> Record:
    time = _read_channel(table, "sim_time")
    # The ball hits both stops at first; after each step it swings far out of the linear range.
    valid = (time >= 2.0) & ~((time >= 10.0) & (time < 12.0)) & ~((time >= 18.0) & (time < 20.0))
    return Record(
        r=_read_channel(table, "sim_pos", 0), u=_read_channel(table, "sim_con"),
        y=_read_channel(table, "sim_pos", 1), dt=1e-3, valid=valid, start=float(time[0]),
        extra={"current": _read_channel(table, "sim_cur")},
        units={"r": "m", "u": "1", "y": "m", "current": "A"},
        names={"r": "reference", "u": "duty", "y": "distance"},
    )  # fmt: skip


def _read_inteco_coil(table: Any) -> Record:
    return Record(
        u=_read_channel(table, "sim_con"), y=_read_channel(table, "sim_cur"), dt=1e-3,
        extra={"distance": _read_channel(table, "sim_pos", 1)},
        units={"u": "1", "y": "A", "distance": "m"},
        names={"u": "duty", "y": "current"},
    )  # fmt: skip


def _read_magnetoshield(table: Any) -> list[Record]:
    whole = np.asarray(table["result"], dtype=float)
    # The set-points were not logged; the magnet settles at these gaps [mm].
    set_points = (14.0, 13.5, 14.5, 15.0, 14.5)
    return [
        Record(
            u=part[:, 1], y=part[:, 0] * 1e-3, dt=3.25e-3, extra={"current": part[:, 2] * 1e-3},
            # The magnet lies on the floor until it is lifted.
            valid=part[:, 0] < 15.6,
            units={"u": "V", "y": "m", "current": "A"},
            names={"u": "solenoid voltage", "y": "gap"}, name=f"set-point {k + 1}, {level:g} mm",
        )
        for k, (part, level) in enumerate(zip(np.split(whole, 5), set_points, strict=True))
    ]  # fmt: skip


def _read_servo(table: Any) -> Record:
    return Record(
        r=_read_channel(table, "ref"),
        u=_read_channel(table, "u"),
        y=_read_channel(table, "y"),
        dt=1e-3,
        extra={"filtered": _read_channel(table, "yf")},
        units={"r": "V", "u": "V", "y": "V", "filtered": "V"},
        names={"r": "reference", "u": "drive voltage", "y": "angle"},
    )


def _read_silverbox(table: Any) -> Record:
    u, y = (_read_channel(table, key) for key in ("V1", "V2"))
    return Record(
        u=u - u.mean(), y=y - y.mean(), dt=1 / 610.35, hold="bandlimited",
        units={"u": "V", "y": "V"}, names={"u": "V1", "y": "V2"},
    )  # fmt: skip


def _choose_tanks_reader(which: str) -> Callable[[Any], Record]:
    def read(table: Any) -> Record:
        return Record(
            u=_read_channel(table, "u" + which), y=_read_channel(table, "y" + which),
            dt=float(_read_channel(table, "Ts")[0]), units={"u": "V", "y": "V"},
            names={"u": "pump voltage", "y": "level sensor"},
        )  # fmt: skip

    return read


def _read_qube(table: Any) -> list[Record]:
    return [
        Record(
            r=table[f"r{k}"].T, u=table[f"u{k}"], y=table[f"y{k}"].T, dt=float(table["dt"]),
            # The pendulum is raised by hand at first.
            valid=np.arange(len(table[f"u{k}"])) >= 500,
            extra={"controller": table[f"uc{k}"], "feedforward": table[f"ff{k}"]},
            names={"r": ("theta", "alpha"), "u": "V", "y": ("theta", "alpha")},
            units={"r": "rad", "u": "V", "y": "rad", "controller": "V", "feedforward": "V"},
            name=str(run).removesuffix(".csv"),
        )
        for k, run in enumerate(table["runs"])
    ]  # fmt: skip


def _read_ip02(table: Any) -> Record:
    return Record(
        u=table["force"], y=np.array([table["cart_pos"], table["pend_pos"]]), dt=0.01,
        start=float(table["time"][0]), names={"u": "F", "y": ("x", "theta")},
        units={"u": "N", "y": ("m", "rad")},
    )  # fmt: skip


def _read_pendubot(table: Any) -> Record:
    # From here on the arm is held upright, and the clock is uniform.
    held = table["t"] >= 4.407
    time = table["t"][held]
    return Record(
        u=table["tau_cmd"][held].T, y=table["q"][held].T, dt=0.0025, start=float(time[0]),
        extra={"measured shoulder torque": table["tau_meas"][held, 0]},
        names={"u": ("tau1", "tau2"), "y": ("q1", "q2")},
        units={"u": "N m", "y": "rad", "measured shoulder torque": "N m"},
    )  # fmt: skip


_QUBE_TEXT = (
    "QUBE-Servo rotary pendulum under two parallel PD, unstable, with independent smooth random "
    "targets of arm and pendulum and voltage added: a list of {} records of 10000 samples at 2 ms. "
    "r and y arm theta and pendulum alpha from upright [rad], u voltage [V] = "
    "extra['controller'] + extra['feedforward'] limited to 10 V. Not valid: the first second, "
    "where the pendulum is raised by hand. A lossless conversion of the published files {}"
)
_IP02_TEXT = (
    "IP02 linear servo with a weighted pendulum, swung up and balanced by an LQR along a "
    "trajectory ({}), which is not filed. {} samples at 10 ms; u commanded force F [N], limited to "
    "6 N, y cart x [m] and pendulum theta from upright [rad]"
)

_EMPS_TEXT = (
    "Electro-mechanical positioning system (EMPS) in closed loop: a carriage on a screw, one "
    "integrator. 24841 samples at 1 ms; r and y position [m], u drive voltage [V]; 35.15 N/V"
)
_SERVO_TEXT = (
    "Servo of a ball-and-beam rig in closed loop, one integrator, {}. {} samples at 1 ms, all in "
    "volts; y angle, extra['filtered'] the y that the controller sees, u = 3 (r - filtered) "
    "limited to 10 V"
)
_TANKS_TEXT = (
    "Two cascaded tanks in open loop, {} data. 1024 samples at 4 s; u pump voltage [V], y level "
    "sensor of the lower tank [V], which clips at 10 V where the tank overflows"
)

_CATALOGUE: dict[str, tuple[Source, Callable[[Any], Any], str]] = {
    "emps": (EMPS, _read_emps, _EMPS_TEXT),
    "emps_pulses": (
        EMPS_PULSES, _read_emps,
        _EMPS_TEXT + ". With pulses added to the drive: u contains them, and extra['pulses'] is "
        "their signal as logged, 0 or 5 V, which moves u by 5.1 to 5.3 V",
    ),
    "inteco_pid_step": (
        INTECO_PID, _read_inteco_pid,
        "INTECO magnetic levitation under PID control, unstable, steps of the reference from 10 to "
        "12 and 8 mm. 24343 samples at 1 ms; r and y distance from the coil [m], u PWM duty from 0 "
        "to 1, extra['current'] of the coil [A]. Not valid: the first 2 s, where the ball hits "
        "both stops, and 2 s from each step, where it swings to 16.8 and 2.6 mm",
    ),
    "inteco_coil_step": (
        INTECO_COIL, _read_inteco_coil,
        "Coil of the INTECO magnetic levitation alone, the ball at rest: a step of the duty from 0 "
        "to 1 at 5 s. 10764 samples at 1 ms; u duty, y coil current [A]",
    ),
    "magnetoshield_r3": (
        MAGNETOSHIELD, _read_magnetoshield,
        "MagnetoShield R3, a levitated permanent magnet under PID control with noise of 2 V peak "
        "to peak added to u, unstable: a list of five records, one per set-point. 1500 samples "
        "each at 3.25 ms; u solenoid voltage [V], y gap [m], extra['current'] of the coil [A], "
        "read after u is applied. Not valid: the magnet on the floor at the start of the first",
    ),
    "ip02_dirtran": (IP02_DIRTRAN, _read_ip02, _IP02_TEXT.format("DIRTRAN", 518)),
    "ip02_rtc": (IP02_RTC, _read_ip02, _IP02_TEXT.format("RTC", 503)),
    "pendubot": (
        PENDUBOT, _read_pendubot,
        "Double pendulum held upright by an LQR at its shoulder, two unstable poles, 6237 samples "
        "at 2.5 ms; u commanded torques [N m] with friction compensation, y joint angles [rad], "
        "(pi, 0) upright. The swing-up before it is left out, since its clock is not uniform. A "
        "lossless conversion of the published trajectory.csv",
    ),
    "qube_estimation": (
        QUBE_ESTIMATION, _read_qube, _QUBE_TEXT.format(3, ", ".join(QUBE_ESTIMATION.originals))
    ),
    "qube_validation": (
        QUBE_VALIDATION, _read_qube, _QUBE_TEXT.format(2, ", ".join(QUBE_VALIDATION.originals))
    ),
    "servo_random_steps": (SERVO_STEPS, _read_servo, _SERVO_TEXT.format("random steps", 59802)),
    "servo_swept_sine": (SERVO_SINE, _read_servo, _SERVO_TEXT.format("swept sine", 60001)),
    "silverbox": (
        SILVERBOX, _read_silverbox,
        "Silverbox, an electronic circuit that imitates a mass on a spring, in open loop. 131072 "
        "samples at 1/610.35 s; u voltage measured behind an anti-aliasing filter, so band-limited "
        "between the samples, y voltage [V], both less their means. About 40700 samples of white "
        "noise of growing amplitude (the arrow), then ten odd random-phase multisines of 8192 "
        "samples",
    ),
    "tanks_estimation": (TANKS, _choose_tanks_reader("Est"), _TANKS_TEXT.format("estimation")),
    "tanks_validation": (TANKS, _choose_tanks_reader("Val"), _TANKS_TEXT.format("validation")),
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


def _find_entry(name: str) -> tuple[Source, Callable[[Any], Any], str]:
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
    Two cascaded tanks in open loop, validation data. 1024 samples at 4 s; ...
    Source: https://raw.githubusercontent.com/forgi86/sysid-neural-unc/...
    Terms: public benchmark; cite Schoukens, Mattson, Wigren, Noël (2016)
    """
    check_arguments(describe, locals())
    source, _, text = _find_entry(name)
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
        The record; ``"magnetoshield_r3"`` is a list of five, one per set-point, and those of the
        QUBE are lists of three and two runs.

    Raises
    ------
    CtrlidError
        If there is no such record, the file cannot be fetched or is not the published one.
    """
    check_arguments(load, locals())
    source, read, _ = _find_entry(name)
    table = _read_file(_find_file(source))
    loaded = read(table)
    if isinstance(loaded, list):
        return [replace(record, name=f"{name} {record.name}") for record in loaded]
    return replace(loaded, name=name)


def _read_file(path: Path) -> Any:
    """Return the arrays of a file by name."""
    if path.suffix == ".npz":
        return np.load(path, allow_pickle=False)
    if path.suffix == ".csv":
        return np.genfromtxt(path, delimiter=",", names=True)
    # Only who loads such a record waits for this import.
    from scipy import io

    return io.loadmat(path)


def _find_file(source: Source) -> Path:
    # Only who loads a record waits for this import.
    import pooch

    folder = os.environ.get(FOLDER_VARIABLE)
    if folder:
        local = Path(folder) / source.file
        if local.is_file():
            if pooch.file_hash(str(local)) != source.sha256:
                raise CtrlidError(
                    f"{local} is not the published file: its SHA-256 is not {source.sha256}. "
                    f"Replace it by {source.address}"
                )
            return local
    if source.originals:
        raise CtrlidError(
            f"{source.file} is a conversion of {', '.join(source.originals)} of {source.address}, "
            "and not published itself. Put it into a folder and name that folder in the "
            f"environment variable {FOLDER_VARIABLE}"
        )
    # A download is not reported, since it is no news to the user.
    pooch.get_logger().setLevel("ERROR")
    try:
        fetched = pooch.retrieve(
            source.address, known_hash=f"sha256:{source.sha256}", path=pooch.os_cache("ctrlid"),
            progressbar=False,
        )  # fmt: skip
    # Pooch hands on whatever its downloader raises.
    except Exception as reason:
        raise CtrlidError(
            f"cannot fetch {source.address} ({type(reason).__name__}: {reason}). Connect to the "
            f"network, or put the file into a folder as {source.file} and name that folder in the "
            f"environment variable {FOLDER_VARIABLE}"
            # The text says all that a page of network frames would.
        ) from None
    return Path(fetched)
