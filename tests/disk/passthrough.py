"""A folder seen through FUSE that is slow, hangs or refuses on demand.

`python -m tests.disk.passthrough FOLDER MOUNTPOINT` mounts until its standard input ends. The rules
lie beside the mount point (`tests/disk/disks.py`).
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

import mfusepy

from tests.disk.disks import CREATE, RENAME, SYNC, WRITE, Faults

MNT_DETACH: Final = 2
_STAT: Final = ("st_gid", "st_mode", "st_nlink", "st_size", "st_uid")
_TIMES: Final = ("st_atime", "st_ctime", "st_mtime")


class Passthrough(mfusepy.Operations):  # type: ignore[misc]
    """Every operation goes to the folder behind; those that change something meet the faults."""

    use_ns = True

    def __init__(self, root: Path, faults: Faults) -> None:
        self._root, self._faults = root, faults

    def _there(self, path: str) -> Path:
        return Path(f"{self._root}{path}")

    def getattr(self, path: str, fh: int | None = None) -> dict[str, Any]:
        found = self._there(path).lstat()
        times = {name: getattr(found, f"{name}_ns") for name in _TIMES}
        return {name: getattr(found, name) for name in _STAT} | times

    def statfs(self, path: str) -> dict[str, Any]:
        found = os.statvfs(self._there(path))
        return {name: getattr(found, name) for name in dir(found) if name.startswith("f_")}

    def access(self, path: str, amode: int) -> int:
        self._there(path).lstat()
        return 0

    def readdir(self, path: str, fh: int) -> list[str]:
        return [".", "..", *(one.name for one in self._there(path).iterdir())]

    def readlink(self, path: str) -> str:
        return str(self._there(path).readlink())

    def open(self, path: str, flags: int) -> int:
        return os.open(self._there(path), flags & ~os.O_NOFOLLOW)

    def create(self, path: str, mode: int, fi: Any = None) -> int:
        self._faults.meet(CREATE, path)
        return os.open(self._there(path), os.O_RDWR | os.O_CREAT | os.O_EXCL, mode)

    def read(self, path: str, size: int, offset: int, fh: int) -> bytes:
        return os.pread(fh, size, offset)

    def write(self, path: str, data: bytes, offset: int, fh: int) -> int:
        self._faults.meet(WRITE, path)
        return os.pwrite(fh, data, offset)

    def truncate(self, path: str, length: int, fh: int | None = None) -> int:
        os.truncate(self._there(path), length)
        return 0

    def flush(self, path: str, fh: int) -> int:
        return 0

    def fsync(self, path: str, datasync: int, fh: int) -> int:
        self._faults.meet(SYNC, path)
        return 0

    def fsyncdir(self, path: str, datasync: int, fh: int) -> int:
        return 0

    def release(self, path: str, fh: int) -> int:
        os.close(fh)
        return 0

    def rename(self, old: str, new: str) -> int:
        self._faults.meet(RENAME, new)
        self._there(old).rename(self._there(new))
        return 0

    def link(self, target: str, source: str) -> int:
        os.link(self._there(source), self._there(target), follow_symlinks=False)
        return 0

    def symlink(self, target: str, source: str) -> int:
        self._there(target).symlink_to(source)
        return 0

    def unlink(self, path: str) -> int:
        self._there(path).unlink()
        return 0

    def mkdir(self, path: str, mode: int) -> int:
        self._there(path).mkdir(mode)
        return 0

    def rmdir(self, path: str) -> int:
        self._there(path).rmdir()
        return 0

    def chmod(self, path: str, mode: int) -> int:
        self._there(path).chmod(mode)
        return 0

    def chown(self, path: str, uid: int, gid: int) -> int:
        os.chown(self._there(path), uid, gid, follow_symlinks=False)
        return 0

    def utimens(self, path: str, times: tuple[int, int] | None = None) -> int:
        when = times or (time.time_ns(), time.time_ns())
        os.utime(self._there(path), ns=when, follow_symlinks=False)
        return 0


def main() -> None:
    root, mountpoint = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()

    def unmount_at_the_end() -> None:
        sys.stdin.read()
        ctypes.CDLL(None, use_errno=True).umount2(os.fsencode(mountpoint), MNT_DETACH)

    threading.Thread(target=unmount_at_the_end, daemon=True).start()
    operations = Passthrough(root, Faults(mountpoint))
    mfusepy.FUSE(operations, str(mountpoint), foreground=True, max_threads=10)


if __name__ == "__main__":
    main()
