"""Pictures of a motion: a contact sheet or a film, to see at a glance what a run did.

They are drawn in numpy with a depth buffer, so that what is hidden is hidden: a floor cuts off what sank into
it. Matplotlib adds what is around: times, the colour bar and a scale bar.
"""

from warpfem.preview.camera import CAMERAS
from warpfem.preview.pictures import MOST_FRAMES, preview

__all__ = ["CAMERAS", "MOST_FRAMES", "preview"]
