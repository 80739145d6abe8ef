"""Files written whole or not at all."""

import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any


@contextmanager
def replace_file(path: str | Path, binary: bool = False) -> Iterator[IO[Any]]:
    """Open a file that takes the place of another when it is complete.

    It is written beside it, so that a full disk or Ctrl-C leaves what was there before, and a
    reader never sees half of it.

    Parameters
    ----------
    path : str or Path
        The file; a link is followed, and a device or a pipe is written as it is.
    binary : bool, optional
        Whether bytes are written; by default text in UTF-8, with line feeds.

    Yields
    ------
    file
        Open for writing.
    """
    form: dict[str, Any] = {} if binary else {"encoding": "utf-8", "newline": "\n"}
    kind = "b" if binary else ""
    target = Path(os.path.realpath(path))
    if target.exists() and not stat.S_ISREG(target.stat().st_mode):
        with target.open(f"w{kind}", **form) as file:
            yield file
        return
    # A name of its own for each writer; the folder is the same, since no file system moves a file
    # to another one in one step.
    beside = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
    try:
        with beside.open(f"x{kind}", **form) as file:
            yield file
        if target.exists():
            shutil.copymode(target, beside)
        beside.replace(target)
    except BaseException:
        with suppress(OSError):
            beside.unlink()
        raise
