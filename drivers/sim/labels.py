"""Faces of cartons: front, side and lid. Grey, 8 bit, seeded."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_sfm.drivers.sim.drawing import (
    FONTS,
    background,
    barcode,
    cloud,
    finish,
    logo,
    put_word,
    small_print,
    word,
    worn_edges,
)
from stereo_sfm.types import U8


def label(rng: np.random.Generator, h: int, w: int) -> U8:
    """One product's front, (h, w)."""
    image, ink, paper = background(rng, h, w)
    if rng.random() < 0.5:  # an illustration of the contents
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
        logo(rng, image, (int(w * rng.uniform(0.25, 0.75)), int(h * rng.uniform(0.35, 0.8))), radius, paper)
    top = int(h * rng.uniform(0.06, 0.4))
    font = int(rng.choice(FONTS))
    put_word(image, word(rng), (int(w * 0.06), top, int(w * 0.88), int(h * 0.2)), ink, font)
    put_word(image, word(rng, False), (int(w * 0.15), top + int(h * 0.2), int(w * 0.6), int(h * 0.1)), ink, font)
    if h > 60:
        x0 = int(w * rng.uniform(0.05, 0.4))
        small_print(rng, image, (x0, int(h * rng.uniform(0.62, 0.8)), int(w * 0.5), int(h * 0.15)), ink)
    worn_edges(image)
    return finish(image + rng.normal(0, 3, (h, w)).astype(np.float32))


def side_label(rng: np.random.Generator, front: U8, h: int, w: int) -> U8:
    """The narrow side of the same box, (h, w): its ground, small print, a barcode."""
    base = float(np.median(front))
    image = np.full((h, w), base, np.float32)
    ink = 20.0 if base > 120 else 230.0
    put_word(image, word(rng), (4, int(h * 0.08), w - 8, int(h * 0.15)), ink, cv2.FONT_HERSHEY_DUPLEX)
    small_print(rng, image, (w // 10, int(h * 0.3), int(w * 0.8), int(h * 0.35)), ink)
    if rng.random() < 0.6 and w > 24:
        barcode(rng, image, (w // 6, int(h * 0.75), int(w * 0.6), int(h * 0.16)))
    worn_edges(image)
    return finish(image)


def top_label(rng: np.random.Generator, front: U8, h: int, w: int) -> U8:
    """The lid, (h, w): flaps and tape."""
    image = (float(np.mean(front)) + 18 * (cloud(rng, (h, w), 3, 4) - 0.5)).astype(np.float32)
    image[h // 2 - 1 : h // 2 + 1] *= 0.5
    if rng.random() < 0.5:
        image[int(h * 0.42) : int(h * 0.58)] += 30
    worn_edges(image)
    return finish(image)
