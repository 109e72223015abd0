"""How sure a share of right answers is; numpy-free, so that predicting may say it, too."""

from __future__ import annotations

#: The 97.5 % point of the normal distribution.
_Z = 1.959963984540054


def wilson_interval(share: float, total: float) -> tuple[float, float]:
    """Return the 95 % score interval of a share of so many independent trials (Wilson 1927).

    Examples
    --------
    >>> [round(end, 4) for end in wilson_interval(0.9, 100)]
    [0.8256, 0.9448]
    """
    extra = _Z * _Z / total
    middle = (share + extra / 2) / (1 + extra)
    half = _Z * (share * (1 - share) / total + extra / (4 * total)) ** 0.5 / (1 + extra)
    return middle - half, middle + half
