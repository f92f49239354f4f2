"""The contract of Camera, for drivers of all vendors."""

# ruff: noqa: S101 - these are tests

from typing import Final

from trade_drivers.interfaces._sensing import Camera
from trade_drivers.testing._asking import at_once, streamed

_BEGINS: Final = {"jpeg": b"\xff\xd8\xff", "png": b"\x89PNG\r\n\x1a\n"}
_BYTES_PER_PIXEL: Final = {"rgb8": 3, "mono8": 1}


class CameraContract:
    """Subclass it with a fixture ``camera``: attached, with a visible scene. Nothing moves."""

    def test_an_image_is_what_it_says_it_is(self, camera: Camera) -> None:
        image, info = camera.image(), camera.info()
        assert image.name == info.name
        assert (image.format, image.width_px, image.height_px) == (info.format, info.width_px, info.height_px)
        assert image.width_px > 0
        assert image.height_px > 0
        if image.format in _BEGINS:
            assert image.data.startswith(_BEGINS[image.format])
        else:
            assert len(image.data) == _BYTES_PER_PIXEL[image.format] * image.width_px * image.height_px

    def test_an_image_has_its_time_of_capture(self, camera: Camera) -> None:
        first = camera.image()
        second = camera.image()
        assert 0 <= first.age_s < 10
        assert second.stamp_ns >= first.stamp_ns

    def test_many_callers_at_once_get_whole_images(self, camera: Camera) -> None:
        info = camera.info()
        for image in at_once(camera.image, 4):
            assert (image.format, image.width_px, image.height_px) == (info.format, info.width_px, info.height_px)

    def test_images_can_be_streamed(self, camera: Camera) -> None:
        first, second = streamed(camera, camera.info().name, "image")
        assert second.stamp_ns > first.stamp_ns
        assert second.name == camera.info().name
        assert second.data
