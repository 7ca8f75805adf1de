"""Drawing primitives of the procedural textures: words, small print, barcodes, logos, clouds. Grey, seeded."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_sfm.types import F32, U8

_SYLLABLES = ("ba", "co", "di", "fe", "go", "ha", "ki", "lu", "mo", "na", "pi", "ro", "sa", "te", "vi", "zu")
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX)


def word(rng: np.random.Generator, upper: bool = True) -> str:
    text = "".join(_SYLLABLES[int(i)] for i in rng.integers(len(_SYLLABLES), size=int(rng.integers(2, 4))))
    return text.upper() if upper else text.capitalize()


def cloud(rng: np.random.Generator, shape: tuple[int, int], octaves: int = 4, cell: int = 8) -> F32:
    """Smooth noise in [0, 1], (H, W), periodic in both axes, `cell` px at its finest octave's double."""
    h, w = shape
    out = np.zeros(shape, np.float32)
    weight = 0.0
    for octave in range(octaves):
        step = cell * 2**octave
        gh, gw = max(h // step, 1), max(w // step, 1)
        grid = rng.random((gh, gw), dtype=np.float32)
        grid = np.pad(grid, 1, mode="wrap")
        big = cv2.resize(grid, ((gw + 2) * (w // gw), (gh + 2) * (h // gh)), interpolation=cv2.INTER_CUBIC)
        y0, x0 = h // gh, w // gw
        out += 2.0**octave * big[y0 : y0 + h, x0 : x0 + w]
        weight += 2.0**octave
    return np.clip(out / weight, 0, 1)


def put_word(image: F32, text: str, box: tuple[int, int, int, int], value: float, font: int) -> None:
    """Draw `text` so that it fills the width of box (x, y, w, h), smooth edges."""
    x, y, w, h = box
    (tw, th), _ = cv2.getTextSize(text, font, 1.0, 2)
    scale = min(w / max(tw, 1), h / max(th, 1))
    if scale <= 0.15:
        return
    thick = max(1, round(2.2 * scale))
    at = (x + int((w - tw * scale) / 2), y + int((h + th * scale) / 2))
    cv2.putText(image, text, at, font, scale, value, thick, cv2.LINE_AA)


def small_print(rng: np.random.Generator, image: F32, box: tuple[int, int, int, int], value: float) -> None:
    """Rows of short bars that look like lines of text from afar."""
    x0, y0, w, h = box
    step = int(rng.integers(5, 9))
    for y in range(y0, y0 + h - 3, step):
        x = x0
        end = x0 + int(w * rng.uniform(0.6, 1.0))
        while x < end:
            run = int(rng.integers(2, 10))
            image[y : y + step // 2, x : min(x + run, end)] = value
            x += run + int(rng.integers(2, 4))


def barcode(rng: np.random.Generator, image: F32, box: tuple[int, int, int, int]) -> None:
    x0, y0, w, h = box
    image[y0 : y0 + h, x0 : x0 + w] = 235
    x = x0 + 3
    while x < x0 + w - 3:
        run = int(rng.integers(1, 4))
        image[y0 + 2 : y0 + h - 5, x : min(x + run, x0 + w - 3)] = 25
        x += run + int(rng.integers(1, 4))


def logo(rng: np.random.Generator, image: F32, center: tuple[int, int], radius: int, value: float) -> None:
    kind = int(rng.integers(4))
    if kind == 0:
        cv2.circle(image, center, radius, value, -1, cv2.LINE_AA)
        cv2.circle(image, center, int(radius * 0.7), 255 - value, max(2, radius // 8), cv2.LINE_AA)
    elif kind == 1:
        axes = (radius, max(2, int(radius * 0.55)))
        cv2.ellipse(image, center, axes, float(rng.uniform(-25, 25)), 0, 360, value, -1, cv2.LINE_AA)
    else:
        n = int(rng.integers(3, 9)) * (2 if kind == 3 else 1)
        angle = np.linspace(0, 2 * np.pi, n, endpoint=False) + rng.uniform(0, 6)
        r = radius * np.where(np.arange(n) % 2 == 0, 1.0, 0.5 if kind == 3 else 1.0)
        points = np.stack([center[0] + r * np.cos(angle), center[1] + r * np.sin(angle)], -1)
        cv2.fillPoly(image, [np.round(points).astype(np.int32)], value, cv2.LINE_AA)


def background(rng: np.random.Generator, h: int, w: int) -> tuple[F32, float, float]:
    """A label's ground and the values of its dark and light print."""
    base = float(rng.choice([rng.uniform(35, 90), rng.uniform(110, 170), rng.uniform(180, 235)]))
    other = float(np.clip(base + rng.choice([-1, 1]) * rng.uniform(25, 80), 20, 240))
    ramp = (
        np.linspace(0, 1, h, dtype=np.float32)[:, None]
        if rng.random() < 0.6
        else np.linspace(0, 1, w, dtype=np.float32)
    )
    image = np.empty((h, w), np.float32)
    image[:] = base + (other - base) * ramp
    dark, light = float(rng.uniform(10, 50)), float(rng.uniform(215, 250))
    return image, (light if base < 120 else dark), (dark if base < 120 else light)


def worn_edges(image: F32) -> None:
    """Rounded, worn edges of a carton: a darker rim."""
    h, w = image.shape
    for i, k in enumerate((0.45, 0.75, 0.92)):
        for line in (np.s_[i, :], np.s_[h - 1 - i, :], np.s_[:, i], np.s_[:, w - 1 - i]):
            image[line] *= k


def finish(image: F32) -> U8:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
