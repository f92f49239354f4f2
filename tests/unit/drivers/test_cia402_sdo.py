"""Transfers to and from a drive's dictionary, answered by the library canopen's server; and noise, which is none."""

import canopen
import pytest
from canopen import objectdictionary as od

from trade_drivers.vendors.cia402._wire import Aborted, Request, Transfer, abort, download, upload

NODE = 5
NAME = "a name that is longer than seven letters"


class Server:
    """The library's node, with frames handed over as they are."""

    def __init__(self) -> None:
        dictionary = od.ObjectDictionary()
        for index, kind, value in (
            (0x1000, od.UNSIGNED32, 0x20192),
            (0x1008, od.VISIBLE_STRING, NAME),
            (0x6040, od.UNSIGNED16, 0),
            (0x6060, od.INTEGER8, 0),
        ):
            entry = od.ODVariable(str(index), index)
            entry.data_type, entry.default, entry.access_type = kind, value, "rw"
            dictionary.add_object(entry)
        self.node = canopen.LocalNode(NODE, dictionary)
        self.node.associate_network(self)  # type: ignore[arg-type]
        self.answers: list[bytes] = []
        self.requests = 0

    def subscribe(self, *_: object) -> None:
        pass

    def send_message(self, _: int, data: bytes, remote: bool = False) -> None:
        self.answers.append(bytes(data))

    def run(self, transfer: Transfer) -> bytes:
        """Carry a transfer through."""
        request = next(transfer)
        while True:
            self.requests += 1
            self.answers.clear()
            self.node.sdo.on_request(0x600 + NODE, bytearray(request.data), 0.0)
            (answer,) = self.answers
            assert request.is_answered_by(answer)
            try:
                request = transfer.send(answer)
            except StopIteration as done:
                return done.value


@pytest.fixture
def server() -> Server:
    return Server()


def test_numbers_are_read_in_one_frame_and_texts_in_several(server: Server) -> None:
    assert server.run(upload(0x1000, 0)) == (0x20192).to_bytes(4, "little")
    assert server.requests == 1
    assert server.run(upload(0x1008, 0)) == NAME.encode()
    assert server.requests == 1 + 1 + 6


@pytest.mark.parametrize(("index", "data"), [(0x6060, b"\x06"), (0x6040, b"\x10\x27"), (0x1000, b"\x01\x02\x03\x04")])
def test_a_written_value_is_read_back(server: Server, index: int, data: bytes) -> None:
    assert server.run(download(index, 0, data)) == b""
    assert server.run(upload(index, 0)) == data


def test_an_sdo_abort_carries_its_code(server: Server) -> None:
    with pytest.raises(Aborted) as refused:
        server.run(upload(0x2000, 0))
    assert refused.value.code == 0x06020000


def first(transfer: Transfer) -> Request:
    return next(transfer)


@pytest.mark.parametrize(
    "frame",
    [
        "",
        "4b6410",  # a piece
        "4341600000000000",  # of another object
        "4f60600100000000",  # of another field
        "6060600000000000",  # that it was written
        "8041600000000206",  # another request was refused
        "0000000000000000",  # a segment
    ],
)
def test_a_frame_of_another_request_is_no_answer(frame: str) -> None:
    request = first(upload(0x6060, 0))
    assert request.is_answered_by(bytes.fromhex("4f60600006000000"))
    assert request.is_answered_by(bytes.fromhex("8060600000000206"))
    assert not request.is_answered_by(bytes.fromhex(frame))


def test_a_segment_that_comes_twice_is_taken_once() -> None:
    transfer = upload(0x1008, 0)
    first(transfer)
    segment = transfer.send(bytes.fromhex("4108100008000000"))
    assert segment.is_answered_by(bytes.fromhex("0041424344454647"))
    second = transfer.send(bytes.fromhex("0041424344454647"))
    assert not second.is_answered_by(bytes.fromhex("0041424344454647"))
    with pytest.raises(StopIteration) as done:
        transfer.send(bytes.fromhex("1d48000000000000"))
    assert done.value.value == b"ABCDEFGH"


def test_a_text_without_end_is_cut_off() -> None:
    transfer = upload(0x1008, 0)
    first(transfer)
    request, answers = transfer.send(bytes.fromhex("4108100000000000")), 0
    with pytest.raises(StopIteration):
        while answers < 100:
            request = transfer.send(bytes((request.data[0] & 0x10,)) + b"ABCDEFG")
            answers += 1


def test_a_transfer_that_is_given_up_names_its_object() -> None:
    assert abort(first(upload(0x1018, 4)), 0x05040000) == bytes.fromhex("8018100400000405")
