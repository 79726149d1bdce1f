"""Machines made of files: a tree of /sys, /proc, /dev and /run/udev as Linux has them."""

from __future__ import annotations

from pathlib import Path

from bilprov.analyzer.transport.machine import Machine


class FakeMachine(Machine):
    """A machine below a folder, to which adapters and processes are added."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        for folder in ("/sys/class/tty", "/proc", "/dev"):
            self.file(folder).mkdir(parents=True)

    def write(self, path: str, text: str = "") -> None:
        file = self.file(path)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")

    def link(self, path: str, target: str) -> None:
        """Make a symbolic link to another path of this machine."""
        file = self.file(path)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.symlink_to(self.file(target))

    def adapter(
        self,
        tty: str = "ttyUSB0",
        identity: str = "0403:6001",
        *,
        driver: str = "ftdi_sio",
        title: str = "FT232R USB UART",
        latency: int | None = 16,
        udev: str = "",
        usb_udev: str = "",
    ) -> str:
        """Plug in a USB adapter with one port; gives the path of the port."""
        usb = "/sys/devices/usb1/1-1"
        serial_device = f"{usb}/1-1:1.0/{tty}" if tty.startswith("ttyUSB") else f"{usb}/1-1:1.0"
        vendor, product = identity.split(":")
        for name, said in {
            "idVendor": vendor,
            "idProduct": product,
            "product": title,
            "serial": "A10K3XYZ",
            "dev": "189:4",
        }.items():
            self.write(f"{usb}/{name}", f"{said}\n")
        self.link("/sys/bus/usb/devices/1-1", usb)
        self.write("/run/udev/data/c189:4", usb_udev)
        if tty:
            self.write(f"/sys/class/tty/{tty}/dev", "188:0\n")
            self.write("/run/udev/data/c188:0", udev)
            self.write(f"{serial_device}/port_number", "0")
            self.link(f"/sys/class/tty/{tty}/device", serial_device)
            self.link(f"{serial_device}/driver", f"/sys/bus/drivers/{driver}")
            if latency is not None:
                self.write(f"{serial_device}/latency_timer", f"{latency}\n")
            self.write(f"/dev/{tty}")
            self.file(f"/dev/{tty}").chmod(0o660)
            self.link("/dev/serial/by-id/usb-FTDI_A10K3XYZ-if00-port0", f"/dev/{tty}")
        return f"/dev/{tty}"

    def run(self, pid: int, name: str, *opened: str, line: str = "") -> None:
        """Start a process that has these paths open."""
        self.write(f"/proc/{pid}/comm", f"{name}\n")
        self.write(f"/proc/{pid}/cmdline", line or f"/usr/bin/{name}\0")
        self.file(f"/proc/{pid}/fd").mkdir()
        for number, path in enumerate(opened, 3):
            self.file(f"/proc/{pid}/fd/{number}").symlink_to(path)
