"""Image metrics written from their formulas in float64, one pixel or one tap at a time."""

from __future__ import annotations

import math

import numpy as np
import torch


def window(length: int) -> list[float]:
    """The 11 px Gaussian of sigma 1.5, or the widest odd one that fits."""
    width = max(w for w in range(1, 12, 2) if w <= length)
    raw = [math.exp(-0.5 * ((i - width // 2) / 1.5) ** 2) for i in range(width)]
    return [w / sum(raw) for w in raw]


def mirrored(index: int, length: int) -> int:
    if index < 0:
        return -index
    return index if index < length else 2 * (length - 1) - index


def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Wang et al. 2004, equation 13, with weighted moments around each pixel."""
    height, width, channels = a.shape
    rows, columns = window(height), window(width)
    result = np.empty(a.shape)
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                samples = []
                for i, wi in enumerate(rows):
                    for j, wj in enumerate(columns):
                        r = mirrored(y + i - len(rows) // 2, height)
                        s = mirrored(x + j - len(columns) // 2, width)
                        samples.append((wi * wj, float(a[r, s, c]), float(b[r, s, c])))
                mean_a = math.fsum(w * p for w, p, _ in samples)
                mean_b = math.fsum(w * q for w, _, q in samples)
                var_a = math.fsum(w * (p - mean_a) ** 2 for w, p, _ in samples)
                var_b = math.fsum(w * (q - mean_b) ** 2 for w, _, q in samples)
                cov = math.fsum(w * (p - mean_a) * (q - mean_b) for w, p, q in samples)
                luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
                result[y, x, c] = luminance * (2 * cov + 9e-4) / (var_a + var_b + 9e-4)
    return result


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    squares = []
    for y in range(a.shape[0]):
        for x in range(a.shape[1]):
            if mask[y, x]:
                squares += [(float(p) - float(q)) ** 2 for p, q in zip(a[y, x], b[y, x], strict=True)]
    return 10 * math.log10(1 / (math.fsum(squares) / len(squares)))


def depth_error_mm(depth: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float | None:
    errors = []
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            if mask[y, x] and math.isfinite(truth[y, x]):
                errors.append(abs(1000.0 * float(depth[y, x]) - 1000.0 * float(truth[y, x])))
    return math.fsum(errors) / len(errors) if errors else None


def perceptual_distance(a, b, convolutions, heads, *, blurred: bool) -> float:
    """Zhang et al. 2018, equation 1, on VGG16.

    Args:
        a: picture `[H, W, 3]` in -1..1.
        b: the other.
        convolutions: 13 pairs of weight `[out, in, 3, 3]` and bias.
        heads: 5 vectors.
        blurred: pool by the maximum of 2x2 at every pixel, a 1-2-1 blur, and every second pixel of that.
    """
    mean, spread = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    features = [_features((p - mean) / spread, convolutions, blurred) for p in (a, b)]
    total = 0.0
    for fa, fb, head in zip(*features, heads, strict=True):
        values = []
        for y in range(fa.shape[0]):
            for x in range(fa.shape[1]):
                u = fa[y, x] / math.sqrt(float(fa[y, x] @ fa[y, x]))
                v = fb[y, x] / math.sqrt(float(fb[y, x] @ fb[y, x]))
                values.append(float(head @ (u - v) ** 2))
        total += math.fsum(values) / len(values)
    return total


def _features(x, convolutions, blurred):
    result, number = [], 0
    for block in (2, 2, 3, 3, 3):
        if result:
            x = _pool_blurred(x) if blurred else _pool(x)
        for _ in range(block):
            x = _convolve(x, *convolutions[number])
            number += 1
        result.append(x)
    return result


def _convolve(x, weight, bias):
    height, width = x.shape[:2]
    padded = np.zeros((height + 2, width + 2, x.shape[2]))
    padded[1:-1, 1:-1] = x
    # torch's float64 product keeps to the threads that the tests allow, numpy's does not
    total = torch.from_numpy(np.tile(bias, (height, width, 1)).astype(np.float64))
    for i in range(3):
        for j in range(3):
            tap = torch.from_numpy(weight[:, :, i, j].T.copy())
            total += torch.from_numpy(padded[i : i + height, j : j + width].copy()) @ tap
    return np.maximum(total.numpy(), 0)


def _pool(x):
    height, width = x.shape[0] // 2, x.shape[1] // 2
    return np.stack(
        [
            np.stack([x[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].max((0, 1)) for j in range(width)])
            for i in range(height)
        ]
    )


def _pool_blurred(x):
    height, width = x.shape[0] - 1, x.shape[1] - 1
    greatest = np.maximum(np.maximum(x[1:, 1:], x[:-1, 1:]), np.maximum(x[1:, :-1], x[:-1, :-1]))
    result = np.zeros(((height + 1) // 2 + 1, (width + 1) // 2 + 1, x.shape[2]))
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            for di, wi in zip((-1, 0, 1), (1, 2, 1), strict=True):
                for dj, wj in zip((-1, 0, 1), (1, 2, 1), strict=True):
                    # sample positions start one pixel before the picture and go on to one after
                    r, c = mirrored(2 * i - 1 + di, height), mirrored(2 * j - 1 + dj, width)
                    result[i, j] += wi * wj / 16 * greatest[r, c]
    return result
