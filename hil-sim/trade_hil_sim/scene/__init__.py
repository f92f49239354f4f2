"""A network camera that sees the simulated robot: pictures drawn from what its devices really do.

`draw` makes such a picture, `fields` says which part of it belongs to which device, `SceneCamera` hands it out.
"""

from ._camera import SceneCamera
from ._drawing import BACKGROUND, LIMB, OBJECT, Field, draw, fields, png

__all__ = ["BACKGROUND", "LIMB", "OBJECT", "Field", "SceneCamera", "draw", "fields", "png"]
