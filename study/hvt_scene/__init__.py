"""The procedurally drawn aerial scene of ``--source demo``, with exact ground truth."""

from hvt_scene.appearance import Appearance
from hvt_scene.scene import Scene
from hvt_scene.truth import CodeInView, Truth

__all__ = ["Appearance", "CodeInView", "Scene", "Truth"]
