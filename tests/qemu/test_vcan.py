"""The CAN transport on a real kernel's sockets, in an emulated machine. Opt-in: `-m qemu`.

The machine sees this one's files read-only, so the same Python environment runs there. Needed:
qemu-system-x86_64, a static busybox, and a Debian kernel package unpacked anywhere::

    apt-get install --no-install-recommends qemu-system-x86 busybox-static
    apt-get download linux-image-6.1.0-56-amd64   # the cloud kernels have no CAN modules
    dpkg-deb -x linux-image-*.deb kernel
    HIL_QEMU_KERNEL=$PWD/kernel pytest -m qemu

By hand: ``python tests/qemu/test_vcan.py KERNEL_FOLDER COMMAND``.
"""

from __future__ import annotations

import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

MODULES = ("virtio_pci", "9pnet_virtio", "9p", "can-raw", "vcan")
CHANNEL = "vcan0"
KERNEL = "HIL_QEMU_KERNEL"
ROOT = Path(__file__).parents[2]
_END = re.compile(r"^command ended with (\d+)\r?$", re.MULTILINE)
_INIT = """#!/bin/busybox sh
busybox mount -t proc proc /proc
busybox mount -t sysfs sysfs /sys
busybox mount -t devtmpfs dev /dev
for module in $(busybox cat /modules/order); do busybox insmod /modules/$module; done
busybox mount -t 9p -o trans=virtio,version=9p2000.L,ro,msize=524288,cache=loose host /host
for place in proc sys dev; do busybox mount -o bind /$place /host/$place; done
busybox mount -t tmpfs tmp {scratch}
busybox ip link set lo up
busybox ip link add dev {channel} type vcan
busybox ip link set {channel} mtu 72
busybox ip link set {channel} up
busybox chroot /host /bin/sh -c {command}
echo "command ended with $?"
busybox poweroff -f
"""


def find_modules(kernel: Path) -> list[Path]:
    """The modules needed with those they need, in the order of loading."""
    files = {path.name.split(".")[0].replace("-", "_"): path for path in kernel.rglob("*.ko")}
    order: list[Path] = []

    def add(name: str) -> None:
        path = files.get(name.replace("-", "_"))
        if path is None:
            raise FileNotFoundError(f"{kernel} has no module {name}")
        found = re.search(rb"depends=([^\0]*)", path.read_bytes())
        for needed in filter(None, (found[1].decode() if found else "").split(",")):
            add(needed)
        if path not in order:
            order.append(path)

    for name in MODULES:
        add(name)
    return order


def cpio(entries: dict[str, bytes | None]) -> bytes:
    """An initial file system (cpio "newc"): folders where the content is None."""
    out = io.BytesIO()
    for number, (name, content) in enumerate([*entries.items(), ("TRAILER!!!", b"")], start=1):
        mode = 0o040755 if content is None else 0o100755
        data = content or b""
        fields = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(name) + 1, 0)
        out.write(b"070701" + b"".join(b"%08X" % field for field in fields))
        for part in (name.encode() + b"\0", data):
            out.write(part)
            out.write(bytes(-out.tell() % 4))
    return out.getvalue()


def initial_files(kernel: Path, command: str, scratch: str) -> bytes:
    """What the machine starts from: busybox, modules, and a script that runs the command."""
    modules = find_modules(kernel)
    busybox = shutil.which("busybox")
    if busybox is None:
        raise FileNotFoundError("busybox is not installed")
    init = _INIT.format(channel=CHANNEL, command=shlex.quote(command), scratch=f"/host{scratch}")
    folders = dict.fromkeys(("bin", "proc", "sys", "dev", "host", "modules"))
    program = Path(busybox).read_bytes()
    files = {
        "init": init.encode(), "bin/busybox": program, "bin/sh": program,
        "modules/order": "\n".join(path.name for path in modules).encode(),
        **{f"modules/{path.name}": path.read_bytes() for path in modules},
    }  # fmt: skip
    return cpio({**folders, **files})


def run(kernel: Path, command: str, *, timeout: float, scratch: str = "/tmp") -> tuple[int, str]:
    """Exit status of a shell command with this machine's paths, and the console.

    Args:
        kernel: folder of the unpacked kernel package.
        command: for /bin/sh.
        timeout: s, boot included.
        scratch: folder that is empty and writable in there.

    Raises:
        RuntimeError: the command did not come to its end; with the console.
    """
    image = next(iter(sorted((kernel / "boot").glob("vmlinuz-*"))))
    with tempfile.TemporaryDirectory() as folder:
        start = Path(folder, "initial.cpio")
        start.write_bytes(initial_files(kernel, command, scratch))
        share = "local,id=host,path=/,security_model=none,readonly=on,multidevs=remap"
        machine = [
            *("qemu-system-x86_64", "-accel", "tcg", "-cpu", "max", "-m", "1536", "-smp", "2"),
            *("-nographic", "-no-reboot", "-nic", "none", "-kernel", str(image)),
            *("-initrd", str(start), "-append", "console=ttyS0 quiet panic=-1"),
            *("-fsdev", share, "-device", "virtio-9p-pci,fsdev=host,mount_tag=host"),
        ]
        done = subprocess.run(
            machine, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            timeout=timeout, check=False,
        )  # fmt: skip
    console = done.stdout.decode(errors="replace")
    ended = _END.search(console)
    if ended is None:
        raise RuntimeError(f"the command did not come to its end:\n{console}")
    return int(ended[1]), console


@pytest.mark.qemu
@pytest.mark.skipif(KERNEL not in os.environ, reason=f"{KERNEL} names no unpacked kernel package")
@pytest.mark.skipif(not shutil.which("qemu-system-x86_64"), reason="qemu is not installed")
def test_the_contract_and_a_session_hold_on_a_real_kernels_can_sockets():
    command = (
        f"cd {shlex.quote(str(ROOT))} && PYTHONDONTWRITEBYTECODE=1 "
        f"{shlex.quote(sys.executable)} -m pytest -p no:cacheprovider -rs --tb=short "
        "tests/drivers/test_can_socketcan.py"
    )
    code, console = run(Path(os.environ[KERNEL]), command, timeout=600.0)
    assert code == 0, console
    assert re.search(r"\d+ passed", console), console
    assert "skipped" not in console, console


if __name__ == "__main__":
    code, text = run(Path(sys.argv[1]).resolve(), " ".join(sys.argv[2:]), timeout=600.0)
    sys.stdout.write(text)
    sys.exit(code)
