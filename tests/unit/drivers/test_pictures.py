"""What the driver of network cameras reads: heads of pictures, and answers by HTTP."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade_drivers.vendors.snapshot._http import Answer, Place, parse_answer, place_of
from trade_drivers.vendors.snapshot._picture import Picture, picture
from trade_hil_sim.scene import png

pytestmark = pytest.mark.virtual_time

APP0 = b"\xff\xe0\x00\x10JFIF\0\1\1\0\0\1\0\1\0\0"
TABLE = b"\xff\xc4\x00\x04ab"
FRAME = b"\xff\xc2\x00\x0b\x08\x01\xe0\x02\x80\x01\x01\x11\x00"
JPEG = b"\xff\xd8" + APP0 + TABLE + FRAME + b"\xff\xda\x00\x02pixels\xff\xd9"
"""640 x 480, progressive, with a table (whose marker looks like a frame's) before the frame."""


def test_a_jpegs_size_is_read_behind_other_segments() -> None:
    assert picture(JPEG) == Picture("jpeg", 640, 480)
    assert picture(JPEG + b"\0" * 60) == Picture("jpeg", 640, 480)


def test_a_pngs_size_is_read() -> None:
    assert picture(png(bytes(3 * 5 * 7), 5, 7)) == Picture("png", 5, 7)


@pytest.mark.parametrize("whole", [JPEG, png(bytes(12), 2, 2)], ids=["jpeg", "png"])
def test_no_picture_that_breaks_off_is_taken_for_one(whole: bytes) -> None:
    for length in range(len(whole)):
        with pytest.raises(ValueError, match=r"no PNG|breaks off"):
            picture(whole[:length])


@given(st.binary(max_size=200))
def test_whatever_bytes_come_are_a_picture_or_refused(data: bytes) -> None:
    for start in (b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"):
        try:
            shown = picture(start + data + (b"\xff\xd9" if start[:1] == b"\xff" else b""))
        except ValueError:
            continue
        assert 0 <= shown.width_px < 2**32
        assert 0 <= shown.height_px < 2**32


def test_an_answer_is_complete_once_all_its_bytes_arrived() -> None:
    whole = b"HTTP/1.1 200 OK\r\nServer: eye\r\ncontent-length: 4\r\n\r\nabcd"
    for length in range(len(whole)):
        assert parse_answer(whole[:length]) is None
    assert parse_answer(whole) == parse_answer(whole + b"more") == Answer(200, "OK", b"abcd")


def test_an_answer_that_is_not_http_is_refused() -> None:
    for bad in (b"SSH-2.0\r\nContent-Length: 0\r\n\r\n", b"HTTP/1.0 fine\r\nContent-Length: 0\r\n\r\n"):
        with pytest.raises(ValueError, match="no HTTP"):
            parse_answer(bad)


def test_an_address_is_taken_apart() -> None:
    assert place_of("http://eye.local:8080/snap?size=1") == Place("eye.local", 8080, "/snap?size=1")
    assert place_of("http://eye") == Place("eye", 80, "/")


@pytest.mark.parametrize("url", ["https://eye/", "http://anna:secret@eye/", "eye", "http:///x", "http://eye/ö"])
def test_an_address_that_cannot_be_asked_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match=r"eye|///x"):
        place_of(url)
