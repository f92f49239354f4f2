"""A serial CAN adapter on a pty, which the system's slcan driver makes an interface of: a real controller's states."""

import fcntl
import os
import select
import struct
import termios
import threading
import tty

import can

from tests.system.socketcan.interfaces import ip

_N_SLCAN = 17
_SIOCGIFNAME = 0x8910
_FRAME = b"t"


class SlcanAdapter:
    """An interface of its own whose wire is another one, ``vcan``, where the drives are.

    It reports the state of its controller that the test sets: error-active, error-warning, error-passive or bus-off.
    """

    def __init__(self, wire: str) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        fcntl.ioctl(self._slave, termios.TIOCSETD, struct.pack("i", _N_SLCAN))
        name = fcntl.ioctl(self._slave, _SIOCGIFNAME, bytes(40))
        self.interface = name[:16].split(b"\0")[0].decode()
        self._wire = can.Bus(interface="socketcan", channel=wire)
        self._wake_read, self._wake_write = os.pipe()
        self.off = False
        """Bus-off: it neither sends nor hears."""
        self.deaf = False
        """It takes nothing from the system, as without anything that acknowledges: the send queue stays full."""
        self._held = b""
        self._thread = threading.Thread(target=self._run, name="slcan adapter", daemon=True)
        self._thread.start()
        ip("link", "set", self.interface, "type", "can", "bitrate", "1000000")
        ip("link", "set", self.interface, "up")

    def say(self, state: str, errors: int) -> None:
        """Tell the state of the controller: ``a``, ``w``, ``p`` or ``b``, and both of its counters of errors."""
        self.off = state == "b"
        os.write(self._master, f"s{state}{errors:03}{errors:03}\r".encode())

    def close(self) -> None:
        os.write(self._wake_write, b"!")
        self._thread.join(10)
        self._wire.shutdown()
        for number in (self._slave, self._master, self._wake_read, self._wake_write):
            os.close(number)

    def _run(self) -> None:
        wire = self._wire.fileno()
        while True:
            watched = [wire, self._wake_read] if self.deaf else [self._master, wire, self._wake_read]
            ready, _, _ = select.select(watched, [], [], 0.1)
            if self._wake_read in ready:
                return
            if self._master in ready:
                self._from_system(os.read(self._master, 4096))
            if wire in ready:
                self._from_wire()

    def _from_system(self, text: bytes) -> None:
        *commands, self._held = (self._held + text).split(b"\r")
        for command in commands:
            if command.startswith(_FRAME) and not self.off:
                data = bytes.fromhex(command[5:].decode())
                self._wire.send(can.Message(arbitration_id=int(command[1:4], 16), data=data, is_extended_id=False))

    def _from_wire(self) -> None:
        frame = self._wire.recv(0)
        if frame is not None and not (self.off or frame.is_error_frame or frame.is_extended_id):
            text = f"t{frame.arbitration_id:03X}{len(frame.data)}{bytes(frame.data).hex().upper()}\r"
            os.write(self._master, text.encode())
