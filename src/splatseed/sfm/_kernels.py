"""Kernel of matching along epipolar lines."""

import numpy as np

from splatseed.runtime.jit import inline


@inline
def match_along_lines(uv, descriptors, others, their_descriptors, matrix, limits, out):
    """For each feature, the one near its epipolar line that is most alike, or -1, into ``out``.

    ``uv`` [M, 2] and ``others`` [N, 2] are pixels of two views, and ``matrix`` [3, 3] maps the
    first's to lines in the second. Descriptors are uint8, so that sums are exact. ``limits`` are
    the pixels from the line, the angle in radians between descriptors, and its share of the angle
    to the second best.
    """
    max_distance, max_angle, max_ratio = limits
    for i in range(len(uv)):
        x, y = uv[i, 0], uv[i, 1]
        a = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]
        b = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]
        c = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
        near = max_distance * np.sqrt(a * a + b * b)
        first, second, best = -1.0, -1.0, -1
        for j in range(len(others)):
            if abs(a * others[j, 0] + b * others[j, 1] + c) <= near:
                both, own, theirs = 0, 0, 0
                for k in range(descriptors.shape[1]):
                    p, q = np.int32(descriptors[i, k]), np.int32(their_descriptors[j, k])
                    both += p * q
                    own += p * p
                    theirs += q * q
                cosine = both / np.sqrt(max(np.float64(own) * np.float64(theirs), 1.0))
                if cosine > first:
                    first, second, best = cosine, first, j
                elif cosine > second:
                    second = cosine
        angle, next_angle = np.arccos(min(first, 1.0)), np.arccos(min(second, 1.0))
        out[i] = best if angle <= max_angle and angle < max_ratio * next_angle else -1
