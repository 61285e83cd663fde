"""Hard inputs of the effects of light, optics and the RGB camera, and the small lights that they are tried on."""

import cv2
import numpy as np

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.effects import EFFECTS, Effect, Stage, effect_class
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import Simulated, simulate
from spikerig.rigctl.sim.spec import Sensor


def own_effects() -> list[str]:
    """Names of the effects of LIGHT, OPTICS and RGB."""
    return [name for name in EFFECTS if effect_class(name).stage in (Stage.LIGHT, Stage.OPTICS, Stage.RGB)]


def drifting(height: int = 20, width: int = 27, seed: int = 0) -> Light:
    """Smooth random light that changes steadily: margins of 160 ticks around an exposure of 80, at 40 kHz."""
    rng = np.random.default_rng(seed)
    rough = rng.uniform(0.02, 1.0, (6, height, width, 3)).astype(np.float32)
    return Light(rough, np.array([0, 80, 160, 200, 240, 400]), (160, 240), 40_000.0, 10**9)


def still(picture: np.ndarray, ticks: int = 400) -> Light:
    """A picture [H,W,3] that stands still over an exposure without margins."""
    return Light(np.asarray(picture, np.float32)[None], np.array([0, ticks]), (0, ticks), 40_000.0)


def textured(height: int = 96, width: int = 128, seed: int = 3) -> np.ndarray:
    """A picture with detail of all sizes, linear, 0.05 to 0.9."""
    rng = np.random.default_rng(seed)
    total = sum(
        cv2.resize(rng.random((height // s + 2, width // s + 2, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
        for s in (2, 5, 13, 40)
    )
    low, high = total.min(), total.max()
    return (0.05 + 0.85 * (total - low) / (high - low)).astype(np.float32)


def run(light: Light, *effects: Effect, seed: int = 1, view: int = 0) -> Simulated:
    """Simulated with a camera of 60 degrees along the longer side."""
    height, width = light.rgb.shape[1:3]
    f = max(height, width) / 2 / np.tan(np.radians(30))
    camera = Camera(np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]), np.zeros(0), width, height)
    return simulate(light, Sensor(), effects, seed, view, camera)


def same(a: Simulated, b: Simulated) -> bool:
    """Whether two simulations agree to the last bit."""
    return (
        np.array_equal(a.spikes.bits, b.spikes.bits)
        and np.array_equal(a.left, b.left)
        and np.array_equal(a.clipped, b.clipped)
        and np.array_equal(a.blurry, b.blurry)
        and np.array_equal(a.frame.pixels, b.frame.pixels)
        and a.frame.row_ns == b.frame.row_ns
    )


OPTICS, RGB, LIGHT = (f"rigctl/test_effects_{part}.py::" for part in ("optics", "rgb", "light"))
ROWS = [
    (
        "one pixel, odd sizes, one row",
        "every effect of light, optics and RGB",
        "shapes as asked, finite",
        RGB + "test_hard_sizes_and_lights",
    ),
    (
        "black, 10 x white",
        "every effect of light, optics and RGB",
        "finite, in range",
        RGB + "test_hard_sizes_and_lights",
    ),
    (
        "50 px of motion an exposure",
        "rolling_shutter",
        "every row its own mean, exact for linear light",
        RGB + "test_fast_motion_row_by_row",
    ),
    ("margins shorter than the read-out", "rolling_shutter", "UsageError", RGB + "test_margins_must_hold_the_readout"),
    ("a ramp down through zero", "brightness_ramp", "no light, never negative", LIGHT + "test_a_ramp_ends_at_zero"),
    ("depth 1", "flicker", "light touches zero, the mean stays", LIGHT + "test_the_mean_over_whole_periods_stays"),
    ("blur of no size", "defocus", "the picture, bit for bit", OPTICS + "test_the_limit_is_absence"),
    (
        "blur wider than the picture",
        "defocus",
        "finite, flat light stays flat",
        OPTICS + "test_blur_keeps_energy_and_moment",
    ),
    ("a gain that falls below zero in the corner", "vignetting", "zero there", OPTICS + "test_vignetting_at_a_radius"),
    ("a lens model that folds over", "distortion", "UsageError", OPTICS + "test_a_lens_that_folds_is_refused"),
    (
        "a shifted arm without geometry",
        "misalignment",
        "UsageError that says why",
        OPTICS + "test_a_shift_needs_geometry",
    ),
    (
        "a map that shrinks threefold",
        "resampler",
        "no aliasing: a fine checker turns gray",
        OPTICS + "test_shrinking_averages",
    ),
    ("a colour without a pixel in reach", "bayer", "gray, no division by zero", RGB + "test_mosaic_of_a_single_pixel"),
    ("pixels of 10 bits", "jpeg", "UsageError; video codes them as 10", RGB + "test_deep_pixels"),
    ("PyAV missing", "video_codec", "HostError, exit 6, names the extra", RGB + "test_missing_pyav"),
]
