"""Procedural pictures: product labels, shelf boards, price rails, floor, ceiling, posters. All grey, 8 bit, seeded."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_sfm.types import F32, U8

_SYLLABLES = ("ba", "co", "di", "fe", "go", "ha", "ki", "lu", "mo", "na", "pi", "ro", "sa", "te", "vi", "zu")
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX)


def _word(rng: np.random.Generator, upper: bool = True) -> str:
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


def _put_word(image: F32, text: str, box: tuple[int, int, int, int], value: float, font: int) -> None:
    """Draw `text` so that it fills the width of box (x, y, w, h), smooth edges."""
    x, y, w, h = box
    (tw, th), _ = cv2.getTextSize(text, font, 1.0, 2)
    scale = min(w / max(tw, 1), h / max(th, 1))
    if scale <= 0.15:
        return
    thick = max(1, round(2.2 * scale))
    at = (x + int((w - tw * scale) / 2), y + int((h + th * scale) / 2))
    cv2.putText(image, text, at, font, scale, value, thick, cv2.LINE_AA)


def _small_print(rng: np.random.Generator, image: F32, box: tuple[int, int, int, int], value: float) -> None:
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


def _barcode(rng: np.random.Generator, image: F32, box: tuple[int, int, int, int]) -> None:
    x0, y0, w, h = box
    image[y0 : y0 + h, x0 : x0 + w] = 235
    x = x0 + 3
    while x < x0 + w - 3:
        run = int(rng.integers(1, 4))
        image[y0 + 2 : y0 + h - 5, x : min(x + run, x0 + w - 3)] = 25
        x += run + int(rng.integers(1, 4))


def _logo(rng: np.random.Generator, image: F32, center: tuple[int, int], radius: int, value: float) -> None:
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


def _background(rng: np.random.Generator, h: int, w: int) -> tuple[F32, float, float]:
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


def label(rng: np.random.Generator, h: int, w: int) -> U8:
    """One product's front, (h, w)."""
    image, ink, paper = _background(rng, h, w)
    if rng.random() < 0.5:  # a picture: blobs of contents
        y0, y1 = int(h * rng.uniform(0.35, 0.5)), int(h * rng.uniform(0.75, 0.95))
        noise = cloud(rng, (y1 - y0, w), 3, int(rng.integers(3, 9)))
        image[y0:y1] = np.where(noise > rng.uniform(0.35, 0.6), noise * 255, image[y0:y1] * 0.8)
    for _ in range(int(rng.integers(1, 4))):  # bands
        y0 = int(rng.uniform(0, 0.9) * h)
        image[y0 : y0 + max(2, int(h * rng.uniform(0.02, 0.12)))] = float(rng.choice([ink, paper]))
    if rng.random() < 0.3:
        p = (rng.random((3, 2)) * (w, h)).astype(np.int32)
        cv2.fillPoly(image, [p], paper, cv2.LINE_AA)
    if rng.random() < 0.75:
        radius = int(min(h, w) * rng.uniform(0.12, 0.3))
        _logo(rng, image, (int(w * rng.uniform(0.25, 0.75)), int(h * rng.uniform(0.35, 0.8))), radius, paper)
    top = int(h * rng.uniform(0.06, 0.4))
    font = int(rng.choice(_FONTS))
    _put_word(image, _word(rng), (int(w * 0.06), top, int(w * 0.88), int(h * 0.2)), ink, font)
    _put_word(image, _word(rng, False), (int(w * 0.15), top + int(h * 0.2), int(w * 0.6), int(h * 0.1)), ink, font)
    if h > 60:
        x0 = int(w * rng.uniform(0.05, 0.4))
        _small_print(rng, image, (x0, int(h * rng.uniform(0.62, 0.8)), int(w * 0.5), int(h * 0.15)), ink)
    _edges(image)
    return _finish(image + rng.normal(0, 3, (h, w)).astype(np.float32))


def side_label(rng: np.random.Generator, front: U8, h: int, w: int) -> U8:
    """The narrow side of the same box, (h, w): its ground, small print, a barcode."""
    base = float(np.median(front))
    image = np.full((h, w), base, np.float32)
    ink = 20.0 if base > 120 else 230.0
    _put_word(image, _word(rng), (4, int(h * 0.08), w - 8, int(h * 0.15)), ink, cv2.FONT_HERSHEY_DUPLEX)
    _small_print(rng, image, (w // 10, int(h * 0.3), int(w * 0.8), int(h * 0.35)), ink)
    if rng.random() < 0.6 and w > 24:
        _barcode(rng, image, (w // 6, int(h * 0.75), int(w * 0.6), int(h * 0.16)))
    _edges(image)
    return _finish(image)


def top_label(rng: np.random.Generator, front: U8, h: int, w: int) -> U8:
    """The lid, (h, w): flaps and tape."""
    image = (float(np.mean(front)) + 18 * (cloud(rng, (h, w), 3, 4) - 0.5)).astype(np.float32)
    image[h // 2 - 1 : h // 2 + 1] *= 0.5
    if rng.random() < 0.5:
        image[int(h * 0.42) : int(h * 0.58)] += 30
    _edges(image)
    return _finish(image)


def _edges(image: F32) -> None:
    """Rounded, worn edges of a carton: a darker rim."""
    h, w = image.shape
    for i, k in enumerate((0.45, 0.75, 0.92)):
        for line in (np.s_[i, :], np.s_[h - 1 - i, :], np.s_[:, i], np.s_[:, w - 1 - i]):
            image[line] *= k


def _finish(image: F32) -> U8:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def price_rail(rng: np.random.Generator, h: int = 32, w: int = 2048) -> U8:
    """A strip of price labels, (h, w), about 0.8 mm a pixel."""
    image = np.full((h, w), 190.0, np.float32)
    image[:3], image[-3:] = 120, 90
    x = 20
    while x < w - 80:
        wide = int(rng.integers(44, 70))
        image[4 : h - 4, x : x + wide] = 245 if rng.random() < 0.8 else 150
        _put_word(image, f"{rng.integers(1, 30)}.{rng.integers(10, 99)}", (x + 3, 6, wide // 2, 15), 15, _FONTS[1])
        _barcode(rng, image, (x + wide // 2 + 4, 8, wide // 2 - 8, 14))
        x += wide + int(rng.integers(30, 150))
    return _finish(image)


def board(rng: np.random.Generator, size: int = 128) -> U8:
    """Painted steel, faintly worn."""
    image = 150 + 30 * (cloud(rng, (size, size), 4, 2) - 0.5) + rng.normal(0, 4, (size, size)).astype(np.float32)
    return _finish(image.astype(np.float32))


def back_panel(rng: np.random.Generator, size: int = 256) -> U8:
    """Perforated back of a gondola."""
    image = (120 + 20 * (cloud(rng, (size, size), 4, 4) - 0.5)).astype(np.float32)
    for y in range(16, size, 32):
        for x in range(16, size, 32):
            cv2.circle(image, (x, y), 5, 35.0, -1, cv2.LINE_AA)
    return _finish(image)


def floor_tiles(rng: np.random.Generator, size: int = 1024, tiles: int = 6) -> U8:
    """Vinyl or stone tiles with grout, speckles and chips; periodic."""
    image = np.empty((size, size), np.float32)
    edge = np.linspace(0, size, tiles + 1).round().astype(int)
    for i in range(tiles):
        for j in range(tiles):
            image[edge[i] : edge[i + 1], edge[j] : edge[j + 1]] = 150 + rng.normal(0, 7)
    image += 36 * (cloud(rng, (size, size), 5, 4) - 0.5)
    for value, count, radius in ((70.0, 1400, 2), (205.0, 1400, 2), (105.0, 500, 4)):
        at = rng.integers(8, size - 8, (count, 2))
        for (x, y), r in zip(at.tolist(), rng.integers(1, radius + 1, count).tolist(), strict=True):
            cv2.circle(image, (x, y), r, value, -1, cv2.LINE_AA)
    for e in edge:
        for k, v in ((0, 70.0), (-1, 85.0)):
            image[(e + k) % size, :] = v
            image[:, (e + k) % size] = v
    return _finish(image)


def floor_scuffs(rng: np.random.Generator, h: int, w: int) -> U8:
    """Wear of the whole floor, multiplied over the tiles: 200 is clean."""
    image = (200 - 60 * np.abs(cloud(rng, (h, w), 6, 8) - 0.5)).astype(np.float32)
    for _ in range(h * w // 3000):
        x, y = int(rng.integers(w)), int(rng.integers(h))
        a = rng.uniform(0, np.pi)
        length = rng.uniform(5, 60)
        p2 = (int(x + length * np.cos(a)), int(y + length * np.sin(a)))
        cv2.line(image, (x, y), p2, float(rng.uniform(110, 175)), int(rng.integers(1, 3)), cv2.LINE_AA)
    for _ in range(h * w // 30000):
        centre = (int(rng.integers(w)), int(rng.integers(h)))
        axes = (int(rng.integers(2, 20)), int(rng.integers(2, 12)))
        cv2.ellipse(
            image, centre, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(140, 190)), -1, cv2.LINE_AA
        )
    return _finish(image)


def ceiling(rng: np.random.Generator, size: int = 1024, panels: int = 4) -> U8:
    """Suspended ceiling, `panels` x `panels` squares, two of them lamps, one a vent; periodic."""
    image = (95 + 14 * (cloud(rng, (size, size), 4, 2) - 0.5)).astype(np.float32)
    for x, y in rng.integers(2, size - 2, (2500, 2)).tolist():
        cv2.circle(image, (x, y), 1, 60.0, -1, cv2.LINE_AA)
    p = size // panels
    for i, j in ((0, 1), (2, 1)):
        image[i * p + 14 : (i + 1) * p - 14, j * p + 14 : (j + 1) * p - 14] = 255
    for y in range(3 * p + 24, 4 * p - 24, 14):
        image[y : y + 6, 3 * p + 24 : 4 * p - 24] = 30
    for k in range(panels):
        image[k * p : k * p + 6] = 140
        image[:, k * p : k * p + 6] = 140
    return _finish(image)


def wall(rng: np.random.Generator, size: int = 512) -> U8:
    """Painted wall panels with joints; periodic."""
    image = (150 + 24 * (cloud(rng, (size, size), 5, 4) - 0.5)).astype(np.float32)
    image[:, :3] = 95
    image[:3] = 120
    image[int(size * 0.7) : int(size * 0.74)] = 90
    return _finish(image)


def poster(rng: np.random.Generator, h: int = 256, w: int = 256) -> U8:
    """A poster or sign: a frame, a picture, a big word."""
    image, ink, paper = _background(rng, h, w)
    y0 = int(h * rng.uniform(0.4, 0.6))
    noise = cloud(rng, (h - y0, w), 4, int(rng.integers(4, 12)))
    image[y0:] = 0.4 * image[y0:] + 150 * noise
    _logo(rng, image, (w // 2, int(h * 0.7)), int(h * 0.18), paper)
    _put_word(image, _word(rng), (w // 16, h // 10, int(w * 0.88), h // 5), ink, int(rng.choice(_FONTS)))
    _small_print(rng, image, (w // 8, int(h * 0.36), int(w * 0.7), int(h * 0.12)), ink)
    image[:5], image[-5:], image[:, :5], image[:, -5:] = 30, 30, 30, 30
    return _finish(image)


def door(rng: np.random.Generator, h: int = 256, w: int = 128) -> U8:
    """A staff door with a window, a handle and a kick plate."""
    image = (110 + 12 * (cloud(rng, (h, w), 4, 4) - 0.5)).astype(np.float32)
    cv2.rectangle(image, (w // 3, h // 8), (2 * w // 3, 3 * h // 8), 40.0, -1)
    cv2.rectangle(image, (w // 3, h // 8), (2 * w // 3, 3 * h // 8), 190.0, 2)
    image[int(h * 0.85) :] = 170
    cv2.rectangle(image, (w - 22, h // 2), (w - 10, h // 2 + 20), 220.0, -1)
    _put_word(image, "EXIT" if rng.random() < 0.5 else "STAFF", (w // 4, h // 2, w // 2, h // 12), 230.0, _FONTS[1])
    image[:4], image[:, :4], image[:, -4:] = 50, 50, 50
    return _finish(image)


def sign(number: int, rng: np.random.Generator, h: int = 128, w: int = 256) -> U8:
    """A hanging aisle sign with its number."""
    image = np.full((h, w), 60.0, np.float32)
    _put_word(image, str(number), (8, 16, w // 4, h - 32), 245.0, _FONTS[1])
    for k in range(3):
        _put_word(image, _word(rng, False), (w // 3, 10 + k * h // 3, int(w * 0.6), h // 4), 235.0, _FONTS[0])
    image[:3], image[-3:], image[:, :3], image[:, -3:] = 200, 200, 200, 200
    return _finish(image)


def cloth(rng: np.random.Generator, size: int = 128) -> U8:
    """Clothes: stripes, checks or a print; periodic."""
    base = float(rng.uniform(40, 180))
    image = base + 30 * (cloud(rng, (size, size), 4, 2) - 0.5)
    step = int(rng.choice([8, 16, 32]))
    contrast = float(rng.uniform(-60, 60))
    if rng.random() < 0.6:
        image[(np.arange(size) // (step // 2)) % 2 == 0] += contrast
    if rng.random() < 0.5:
        image[:, (np.arange(size) // (step // 2)) % 2 == 0] -= contrast
    return _finish(image.astype(np.float32))


def plain(rng: np.random.Generator, grey: float, size: int = 64) -> U8:
    """Hair, skin: one grey, faintly uneven; periodic."""
    return _finish((grey + 16 * (cloud(rng, (size, size), 3, 4) - 0.5)).astype(np.float32))
