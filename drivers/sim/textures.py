"""Procedural textures of the building: boards, price rails, floor, ceiling, posters, signs, clothes. Grey, seeded."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_sfm.drivers.sim.drawing import FONTS, background, barcode, cloud, finish, logo, put_word, small_print, word
from stereo_sfm.types import U8


def price_rail(rng: np.random.Generator, h: int = 32, w: int = 2048) -> U8:
    """A strip of price labels, (h, w), about 0.8 mm a pixel."""
    image = np.full((h, w), 190.0, np.float32)
    image[:3], image[-3:] = 120, 90
    x = 20
    while x < w - 80:
        wide = int(rng.integers(44, 70))
        image[4 : h - 4, x : x + wide] = 245 if rng.random() < 0.8 else 150
        put_word(image, f"{rng.integers(1, 30)}.{rng.integers(10, 99)}", (x + 3, 6, wide // 2, 15), 15, FONTS[1])
        barcode(rng, image, (x + wide // 2 + 4, 8, wide // 2 - 8, 14))
        x += wide + int(rng.integers(30, 150))
    return finish(image)


def board(rng: np.random.Generator, size: int = 128) -> U8:
    """Painted steel, faintly worn."""
    image = 150 + 30 * (cloud(rng, (size, size), 4, 2) - 0.5) + rng.normal(0, 4, (size, size)).astype(np.float32)
    return finish(image.astype(np.float32))


def back_panel(rng: np.random.Generator, size: int = 256) -> U8:
    """Perforated back of a gondola."""
    image = (120 + 20 * (cloud(rng, (size, size), 4, 4) - 0.5)).astype(np.float32)
    for y in range(16, size, 32):
        for x in range(16, size, 32):
            cv2.circle(image, (x, y), 5, 35.0, -1, cv2.LINE_AA)
    return finish(image)


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
    return finish(image)


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
    return finish(image)


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
    return finish(image)


def wall(rng: np.random.Generator, size: int = 512) -> U8:
    """Painted wall panels with joints; periodic."""
    image = (150 + 24 * (cloud(rng, (size, size), 5, 4) - 0.5)).astype(np.float32)
    image[:, :3] = 95
    image[:3] = 120
    image[int(size * 0.7) : int(size * 0.74)] = 90
    return finish(image)


def poster(rng: np.random.Generator, h: int = 256, w: int = 256) -> U8:
    """A poster or sign: a frame, an image, a big word."""
    image, ink, paper = background(rng, h, w)
    y0 = int(h * rng.uniform(0.4, 0.6))
    noise = cloud(rng, (h - y0, w), 4, int(rng.integers(4, 12)))
    image[y0:] = 0.4 * image[y0:] + 150 * noise
    logo(rng, image, (w // 2, int(h * 0.7)), int(h * 0.18), paper)
    put_word(image, word(rng), (w // 16, h // 10, int(w * 0.88), h // 5), ink, int(rng.choice(FONTS)))
    small_print(rng, image, (w // 8, int(h * 0.36), int(w * 0.7), int(h * 0.12)), ink)
    image[:5], image[-5:], image[:, :5], image[:, -5:] = 30, 30, 30, 30
    return finish(image)


def door(rng: np.random.Generator, h: int = 256, w: int = 128) -> U8:
    """A staff door with a window, a handle and a kick plate."""
    image = (110 + 12 * (cloud(rng, (h, w), 4, 4) - 0.5)).astype(np.float32)
    cv2.rectangle(image, (w // 3, h // 8), (2 * w // 3, 3 * h // 8), 40.0, -1)
    cv2.rectangle(image, (w // 3, h // 8), (2 * w // 3, 3 * h // 8), 190.0, 2)
    image[int(h * 0.85) :] = 170
    cv2.rectangle(image, (w - 22, h // 2), (w - 10, h // 2 + 20), 220.0, -1)
    put_word(image, "EXIT" if rng.random() < 0.5 else "STAFF", (w // 4, h // 2, w // 2, h // 12), 230.0, FONTS[1])
    image[:4], image[:, :4], image[:, -4:] = 50, 50, 50
    return finish(image)


def sign(number: int, rng: np.random.Generator, h: int = 128, w: int = 256) -> U8:
    """A hanging aisle sign with its number."""
    image = np.full((h, w), 60.0, np.float32)
    put_word(image, str(number), (8, 16, w // 4, h - 32), 245.0, FONTS[1])
    for k in range(3):
        put_word(image, word(rng, False), (w // 3, 10 + k * h // 3, int(w * 0.6), h // 4), 235.0, FONTS[0])
    image[:3], image[-3:], image[:, :3], image[:, -3:] = 200, 200, 200, 200
    return finish(image)


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
    return finish(image.astype(np.float32))


def plain(rng: np.random.Generator, grey: float, size: int = 64) -> U8:
    """Hair, skin: one grey, faintly uneven; periodic."""
    return finish((grey + 16 * (cloud(rng, (size, size), 3, 4) - 0.5)).astype(np.float32))
