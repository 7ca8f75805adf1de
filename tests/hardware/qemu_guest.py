"""Boot a Debian kernel with vhci_hcd in QEMU, on this computer's own files (read-only), and run kernel_usb in it.

Needs: qemu-system-x86_64 (apt install qemu-system-x86), busybox (static), and an unpacked Debian
kernel package:  apt-get download linux-image-6.1.0-NN-amd64 && dpkg -x linux-image-*.deb KERNEL
Run:  python -m tests.hardware.qemu_guest --kernel KERNEL [--seconds 10] [--faults unplug]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
_MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "vhci-hcd")
_INIT = """#!/bin/busybox sh
/bin/busybox mkdir -p /proc /sys /dev /host /rw /root
/bin/busybox mount -t proc proc /proc
/bin/busybox mount -t sysfs sys /sys
/bin/busybox mount -t devtmpfs dev /dev
for module in {modules}; do /bin/busybox insmod /modules/$module || echo "cannot load $module"; done
/bin/busybox mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=loose,ro host /host
/bin/busybox mount -t tmpfs tmpfs /rw
/bin/busybox mkdir -p /rw/up /rw/work /root
/bin/busybox mount -t overlay -o lowerdir=/host,upperdir=/rw/up,workdir=/rw/work overlay /root
for place in proc sys dev; do /bin/busybox mkdir -p /root/$place; /bin/busybox mount -o bind /$place /root/$place; done
/bin/busybox mount -t tmpfs tmpfs /root/tmp
/bin/busybox ip link set lo up
/bin/busybox ip addr add 127.0.0.1/8 dev lo
echo 1000 > /sys/module/usbcore/parameters/usbfs_memory_mb
/bin/busybox chroot /root /bin/sh -c 'cd {root} && {environment} {command}'
echo "GUEST EXIT $?"
/bin/busybox poweroff -f
"""


def missing(kernel: Path | None) -> str:
    """What this computer lacks; empty when it can run."""
    if shutil.which("qemu-system-x86_64") is None:
        return "needs qemu-system-x86_64 (apt install qemu-system-x86)"
    if shutil.which("busybox") is None:
        return "needs a static busybox (apt install busybox-static)"
    if kernel is None or not list(kernel.glob("boot/vmlinuz-*")):
        return "needs an unpacked Debian kernel package (apt-get download linux-image-6.1.0-NN-amd64; dpkg -x it DIR)"
    return ""


def _load_order(modules: Path) -> list[Path]:
    """The wanted modules after all that they depend on, from the names in their .modinfo."""
    paths = {p.stem.replace("-", "_"): p for p in modules.rglob("*.ko")}
    order: list[Path] = []

    def add(name: str) -> None:
        path = paths.get(name.replace("-", "_"))
        if path is None or path in order:
            return
        info = path.read_bytes()
        at = info.find(b"\0depends=")
        names = info[at + 9 : info.index(b"\0", at + 9)].decode() if at >= 0 else ""
        for dependency in filter(None, names.split(",")):
            add(dependency)
        order.append(path)

    for name in _MODULES:
        add(name)
    return order


def _initramfs(kernel: Path, folder: Path, command: str) -> Path:
    """busybox, modules, and the script above, packed."""
    tree = folder / "tree"
    (tree / "bin").mkdir(parents=True)
    (tree / "modules").mkdir()
    shutil.copy(shutil.which("busybox") or "busybox", tree / "bin" / "busybox")
    order = _load_order(next((kernel / "lib" / "modules").iterdir()))
    for path in order:
        shutil.copy(path, tree / "modules" / path.name)
    environment = "HOME=/tmp NUMBA_CACHE_DIR=/tmp PYTHONDONTWRITEBYTECODE=1 OMP_NUM_THREADS=1"
    names = " ".join(p.name for p in order)
    init = tree / "init"
    init.write_text(_INIT.format(modules=names, root=ROOT, environment=environment, command=command))
    init.chmod(0o755)
    packed = folder / "initramfs.cpio"
    files = "\n".join(str(p.relative_to(tree)) for p in sorted(tree.rglob("*")))
    with packed.open("wb") as out:
        subprocess.run(["busybox", "cpio", "-o", "-H", "newc"], input=files.encode(), stdout=out, cwd=tree, check=True,
                       stderr=subprocess.DEVNULL)  # fmt: skip
    return packed


def run_in_guest(
    kernel: Path, arguments: list[str], timeout_s: float = 300, accel: str = "tcg"
) -> tuple[dict[str, Any] | None, str]:
    """Boot, run kernel_usb, power off.

    Returns:
        Its report (None when it did not come so far), and all that the guest said.
    """
    command = " ".join([sys.executable, "-m", "tests.hardware.kernel_usb", *arguments])
    with tempfile.TemporaryDirectory() as name:
        image = next(kernel.glob("boot/vmlinuz-*"))
        qemu = ["qemu-system-x86_64", "-m", "2048", "-smp", "2", "-nographic", "-no-reboot", "-kernel", str(image)]
        qemu += ["-initrd", str(_initramfs(kernel, Path(name), command)), "-append", "console=ttyS0 panic=-1"]
        qemu += ["-fsdev", "local,id=host,path=/,security_model=none,readonly=on,multidevs=remap"]
        qemu += ["-device", "virtio-9p-pci,fsdev=host,mount_tag=host"]
        qemu += ["-accel", accel, "-cpu", "host" if accel == "kvm" else "max"]
        console = Path(name) / "console"
        with console.open("wb") as out, contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(
                qemu, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT, timeout=timeout_s, check=False
            )
        message = console.read_text(errors="replace")
    line = next((text for text in message.splitlines() if text.startswith("REPORT ")), None)
    return (json.loads(line.removeprefix("REPORT ")) if line else None), message


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", type=Path, help="unpacked kernel package (also $STEREO_SFM_GUEST_KERNEL)")
    parser.add_argument("--seconds", default="10")
    parser.add_argument("--faults", default="none")
    parser.add_argument("--paced", action="store_true", help="30 Hz, which an emulated processor cannot follow")
    parser.add_argument("--accel", choices=("tcg", "kvm"), default="tcg", help="kvm is fast, where it works")
    parser.add_argument("--timeout", type=float, default=300, help="seconds for the guest")
    options = parser.parse_args()
    given = options.kernel or (Path(k) if (k := os.environ.get("STEREO_SFM_GUEST_KERNEL")) else None)
    lack = missing(given)
    if lack or given is None:
        print(lack, file=sys.stderr)
        return 2
    arguments = ["--seconds", options.seconds, "--faults", options.faults, *(["--paced"] if options.paced else [])]
    report, message = run_in_guest(given, arguments, options.timeout, options.accel)
    if report is None:
        print(message)
        return 1
    print(json.dumps(report, indent=2))
    return 3 if report["wrong_images"] else 0


if __name__ == "__main__":
    sys.exit(main())
