"""How a scene looks: the parameters that the demo leaves at their defaults and that training randomises."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

Bgr = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Appearance:
    """Light, surfaces, camera and density of one scene; angles in degrees, lengths in metres."""

    shadow_azimuth_deg: float = 38.0
    """Where shadows fall, clockwise from east (the world's x axis; y points south)."""
    shadow_per_m: float = 0.62
    """Length of the shadow of a thing one metre high; 0 at noon in the tropics."""
    shadow_strength: float = 0.52
    """Share of the light that a shadow takes away, 0…1; 0 draws none."""
    exposure: float = 1.0
    """Gain on every pixel."""
    grass_bgr: Bgr = (64.0, 112.0, 98.0)
    soil_bgr: Bgr = (104.0, 133.0, 154.0)
    asphalt_bgr: Bgr = (92.0, 90.0, 88.0)
    paving_bgr: Bgr = (158.0, 164.0, 168.0)
    texture_gain: float = 1.0
    """Strength of the ground's noise."""
    width_m: tuple[float, float, float] = (140.0, 112.0, 134.0)
    """Ground width that the picture spans at the beginning, the middle and the end."""
    roll_deg: tuple[float, float] = (-5.0, 6.0)
    """Rotation of the camera about its axis at the beginning and at the end."""
    tilt_deg: float = 0.0
    """0 looks straight down, up to 40; heights of things are not drawn, so keep it moderate."""
    shake_px: float = 1.6
    """Amplitude of the camera's shake, pixels of a 1920-wide picture."""
    occupancy: float = 0.72
    """Share of parking stalls that are taken."""
    traffic_gap_m: float = 26.0
    """Mean free gap between vehicles on the roads."""

    @property
    def shadow_vector(self) -> tuple[float, float]:
        """(x, y) metres of shadow per metre of height."""
        angle = math.radians(self.shadow_azimuth_deg)
        return (self.shadow_per_m * math.cos(angle), self.shadow_per_m * math.sin(angle))

    @classmethod
    def random(cls, seed: int) -> Appearance:
        """A strongly varied look for training: light, season, altitude, tilt, density."""
        rng = np.random.Generator(np.random.PCG64([seed, 77]))
        width = float(rng.uniform(70, 150))
        spin = float(rng.uniform(-180, 180))

        def tinted(colour: Bgr, spread: float) -> Bgr:
            gain = rng.uniform(1 - spread, 1 + spread)
            blue, green, red = (float(np.clip(c * gain + rng.normal(0, 4), 8, 235)) for c in colour)
            return (blue, green, red)

        return cls(
            shadow_azimuth_deg=float(rng.uniform(0, 360)),
            shadow_per_m=float(rng.uniform(0.1, 1.5)),
            shadow_strength=float(rng.uniform(0.0, 0.7)),
            exposure=float(rng.uniform(0.6, 1.3)),
            grass_bgr=tinted((64.0, 112.0, 98.0), 0.4),
            soil_bgr=tinted((104.0, 133.0, 154.0), 0.3),
            asphalt_bgr=tinted((92.0, 90.0, 88.0), 0.35),
            paving_bgr=tinted((158.0, 164.0, 168.0), 0.2),
            texture_gain=float(rng.uniform(0.5, 1.8)),
            width_m=(width, width * float(rng.uniform(0.75, 1.0)), width * float(rng.uniform(0.75, 1.0))),
            roll_deg=(spin, spin + float(rng.uniform(-15, 15))),
            tilt_deg=float(rng.choice([0.0, 0.0, rng.uniform(0, 30)])),
            occupancy=float(rng.uniform(0.3, 0.95)),
            traffic_gap_m=float(rng.uniform(8, 45)),
        )
