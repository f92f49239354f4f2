"""A client of socketcand that sends several frames in one write."""

from collections.abc import Iterable

import can
from can.interfaces.socketcand import SocketCanDaemonBus
from can.interfaces.socketcand.socketcand import convert_can_message_to_ascii_message


class ServerBus(SocketCanDaemonBus):
    """python-can's bus; each write wakes the server and is acknowledged, so several frames share one."""

    def send_all(self, messages: Iterable[can.Message]) -> None:
        """Sends frames in this order."""
        self._tcp_send("".join(map(convert_can_message_to_ascii_message, messages)))
