"""The node: ``python3 -m _node FD MASTER NODE``. Frames on a socket control what it opens; it ends with the socket."""

# pyright: basic, reportMissingImports=false

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

# where ROS installs its packages, in case its setup file was not sourced
sys.path.extend(sorted(str(path) for path in Path("/opt/ros").glob("*/lib/python3/dist-packages")))
try:
    import rospy
except ImportError as missing:
    sys.exit(f"{sys.executable} has no rospy ({missing}). Install python3-rospy, or configure another Python")

import rosgraph.xmlrpc
import rospy.core
import rospy.impl.masterslave
import rospy.impl.statistics
import rospy.impl.tcpros
import rospy.impl.tcpros_base
import rospy.names

from ._calls import call
from ._frames import Channel, Head
from ._heart import Heart
from ._master import Unreachable, ask
from ._peers import Peers
from ._registrar import Registrar

_REPLY_S = 3600.0
"""The longest time that a service of TRADE may take."""
_END_S = 2.0


class Node:
    """The node."""

    def __init__(self, channel: Channel, master: str, name: str) -> None:
        self._channel = channel
        self._heart = Heart(channel)
        self._master = master
        self._name = name
        self._open: dict[int, Any] = {}
        self._classes: dict[tuple[str, str], Any] = {}
        self._replies: dict[int, tuple[threading.Event, list]] = {}
        self._asked = int.from_bytes(os.urandom(6), "little")  # a reply for the previous node has no recipient
        self._lock = threading.Lock()
        self._peers = Peers(lambda name, there: channel.put({"op": "node", "name": name, "there": there}))
        self._registrar = Registrar(master, name, _started(master, name), self._peers, self._healthy)

    def heard(self, head: Head, body: bytes) -> None:
        """Executes a frame."""
        try:
            if "ask" in head and head["op"] != "reply":
                threading.Thread(target=self._answer, args=(head, body), daemon=True).start()
            else:
                getattr(self, "_" + head["op"])(head, body)
        except Exception:
            logging.getLogger("rosout").exception("cannot %s %s", head["op"], head.get("name", ""))

    def end(self) -> None:
        """Unregister."""
        self._registrar.end(_END_S)

    def _healthy(self, problem: str) -> None:
        self._heart.worked()
        self._channel.put({"op": "health", "problem": problem}, key="health", most=1)

    # --- topics

    def _publish(self, head: Head, _: bytes) -> None:
        made = rospy.Publisher(head["name"], self._class(head), latch=head["latched"], queue_size=head["most"])
        self._opened(head, made)

    def _message(self, head: Head, body: bytes) -> None:
        publisher = self._open.get(head["id"])
        if publisher is not None:
            publisher.publish(_filled(publisher.data_class, body))

    def _subscribe(self, head: Head, _: bytes) -> None:
        number, most, latched = head["id"], head["most"], head["latched"]
        met = f"trade/{number}"

        def came(message: Any) -> None:
            header = message._connection_header  # one object for all messages of a connection
            if not latched and header.get("latching") == "1" and met not in header:
                header[met] = "1"  # ROS does not say whether the first message is as old as its publisher
                return
            frame = {"op": "heard", "id": number, "who": header.get("callerid", ""), "at": time.monotonic()}
            self._channel.put(frame, message._buff, key=str(number), most=most)

        self._opened(head, rospy.Subscriber(head["name"], self._class(head), came, tcp_nodelay=True))

    def _close(self, head: Head, _: bytes) -> None:
        opened = self._open.pop(head["id"], None)
        if isinstance(opened, rospy.Service):
            opened.shutdown()
        elif opened is not None:
            opened.unregister()
        self._registrar.wake()

    def _opened(self, head: Head, made: Any) -> None:
        self._open[head["id"]] = made
        self._registrar.wake()

    # --- services

    def _serve(self, head: Head, _: bytes) -> None:
        service = self._service(head)

        def asked(request: Any) -> Any:
            who = request._connection_header.get("callerid", "")
            return _filled(service._response_class, self._asked_for(head["id"], who, request._buff))

        self._opened(head, rospy.Service(head["name"], service, asked, error_handler=lambda *_: None))

    def _asked_for(self, number: int, who: str, body: bytes) -> bytes:
        replied, reply = threading.Event(), []
        with self._lock:
            self._asked += 1
            asked = self._asked
            self._replies[asked] = replied, reply
        request = {"op": "request", "id": number, "ask": asked, "who": who, "at": time.monotonic()}
        self._channel.put(request, body)
        came = replied.wait(_REPLY_S)
        with self._lock:
            self._replies.pop(asked, None)
        if not came:
            raise rospy.ServiceException(f"no answer within {_REPLY_S:g} s")
        head, answer = reply
        if head["problem"]:
            raise rospy.ServiceException(head["problem"])
        return answer

    def _reply(self, head: Head, body: bytes) -> None:
        with self._lock:
            waiting = self._replies.get(head["ask"])
        if waiting is not None:
            waiting[1].extend((head, body))
            waiting[0].set()

    # --- requests of TRADE

    def _answer(self, head: Head, body: bytes) -> None:
        reply: Head = {"op": "answer", "ask": head["ask"], "failed": ""}
        answer = b""
        try:
            reply["value"], answer = getattr(self, "_" + head["op"])(head, body)
        except Unreachable as error:
            reply.update(failed="unreachable", problem=str(error))
        except Exception as error:  # noqa: BLE001 - also what rospy raises: TRADE needs an answer
            reply.update(failed="refused", problem=str(error) or repr(error))
        self._channel.put(reply, answer)

    def _call(self, head: Head, body: bytes) -> tuple[Any, bytes]:
        service = self._service(head)
        return None, call(self._master, self._name, head["name"], service, body, head["timeout_s"])

    def _parameters(self, head: Head, _: bytes) -> tuple[Any, bytes]:
        return ask(self._master, "getParam", self._name, head["name"], timeout_s=head["timeout_s"]), b""

    def _set_parameter(self, head: Head, _: bytes) -> tuple[Any, bytes]:
        asked = (self._name, head["name"], head["value"])
        return ask(self._master, "setParam", *asked, timeout_s=head["timeout_s"]), b""

    def _connected(self, head: Head, _: bytes) -> tuple[Any, bytes]:
        """Names of the nodes at the other ends of topics."""
        return [self._ends(number) for number in head["ids"]], b""

    def _ends(self, number: int) -> Any:
        opened = self._open.get(number)
        if opened is None:
            return []
        named = "endpoint_id" if isinstance(opened, rospy.Publisher) else "callerid_pub"
        return sorted({getattr(connection, named) for connection in opened.impl.connections})

    # --- classes for raw bytes

    def _class(self, wire: Head) -> Any:
        key = wire["type"], wire["md5"]
        if key not in self._classes:
            named = {"_type": wire["type"], "_md5sum": wire["md5"], "_full_text": wire["text"], "_has_header": False}
            self._classes[key] = type("Raw", (rospy.AnyMsg,), dict(named, _slot_types=[]))
        return self._classes[key]

    def _service(self, head: Head) -> Any:
        parts = {"_request_class": self._class(head["request"]), "_response_class": self._class(head["response"])}
        return type("Service", (), dict(parts, _type=head["type"], _md5sum=head["md5"]))


def _filled(type_: Any, body: bytes) -> Any:
    message = type_()
    message._buff = body
    return message


def _started(master: str, name: str) -> Any:
    """Starts rospy's servers without its registration at the master, which blocks, and registers only once."""
    # both of these would query the master and wait for it
    rospy.impl.tcpros_base._use_tcp_keepalive = True
    rospy.impl.statistics.SubscriberStatisticsLogger.is_enabled = staticmethod(lambda: False)
    rospy.impl.tcpros.init_tcpros()
    rospy.impl.tcpros_base.start_tcpros_server()
    rospy.names._set_caller_id(name)
    handler = rospy.impl.masterslave.ROSHandler(name, None)
    server = rosgraph.xmlrpc.XmlRpcNode(0, handler)
    server.start()
    deadline = time.monotonic() + 10
    while not (server.uri and handler._is_registered()):
        if time.monotonic() > deadline:
            sys.exit("cannot listen. Is ROS_IP or ROS_HOSTNAME an address of this host?")
        time.sleep(0.005)
    handler.masterUri = master
    rospy.core.set_node_uri(server.uri)
    rospy.core.set_initialized(True)
    rospy.rostime.set_rostime_initialized(True)
    return handler


def main() -> None:
    """Runs until the socket is closed or the master requests a shutdown."""
    for meant_for_trade in (signal.SIGINT, signal.SIGTERM):  # TRADE still sends frames, and ends us by the socket
        signal.signal(meant_for_trade, signal.SIG_IGN)
    logging.basicConfig(level=logging.ERROR, stream=sys.stderr, format="%(message).300s")
    number, master, name = sys.argv[1:]
    rospy.names.reload_mappings([])
    channel = Channel(socket.socket(fileno=int(number)), "ros1")
    rospy.core.add_preshutdown_hook(lambda reason: (sys.stderr.write(reason + "\n"), channel.close()))
    node = Node(channel, master, name)
    channel.read(node.heard)
    node.end()
    sys.stderr.flush()
    os._exit(0)  # rospy leaves threads that cannot be ended


if __name__ == "__main__":
    main()
