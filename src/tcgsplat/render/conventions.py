"""Numbers that all rasterizers share, so that they draw the same."""

NEAR_PLANE = 0.2
"""Splats whose centre is nearer than this are not drawn, metres."""
MAX_OPACITY = 0.99
"""Opacity is clipped to this where `Splats` are made, so that no pixel is ever fully opaque."""
MIN_ALPHA = 1.0 / 255.0
"""Contributions below this are skipped: they end each splat's footprint."""
MIN_TRANSMITTANCE = 1e-4
"""A backend may stop once every pixel it works on lets less than this through; the oracle never stops."""
BLUR = 0.3
"""Added to both variances of a projected splat, square pixels: none is thinner than a pixel can show."""
PLANE_SOFTENING = 0.001
"""Added to the unblurred image variances where a splat's plane is solved for, square pixels: edge-on stays finite. Far
less than the variances of what is seen aslant from afar: else such surfaces come nearer, as splats of all depths share
a pixel there and the nearest hide the others."""
JACOBIAN_MARGIN = 0.3
"""The projection's slope is taken inside the image widened by this share of its half size (as gsplat does): far
outside, the linearisation would blow splats up across the whole image."""
