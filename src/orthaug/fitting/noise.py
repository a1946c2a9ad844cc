"""Declarations of the errors' colour: of lagged physics one step ahead, and of motions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from orthaug._base.checks import check_count
from orthaug._base.errors import InputError, show

OF_MOTIONS = (
    "is for motions, whose states follow a predictor; take auto, or arma with the orders ar and ma"
)
OF_LAGGED = (
    "is for lagged physics one step ahead; take innovations, whose gain is estimated, auto or white"
)

Order = int | Literal["auto"]


@dataclass(frozen=True)
class ARMA:
    """Declaration: errors `D(q) v_k = C(q) e_k` of every output, with orders `ar` and `ma`.

    `C/D` is in the equation of the lagged form, `y = φθ + f + (C/D) e`. So `ar = 0` is ARMAX where
    φ has lagged outputs, and `ma = 0` is ARARX. White noise on a sensor is about `ma` = the number
    of lagged outputs; Box and Jenkins' model has `ma` and `ar` both.

    Args:
        ar: order of D; "auto" to choose it.
        ma: order of C; "auto" to choose it.
        largest: up to which an order is chosen.

    Examples:
        >>> ARMA(ar=2, ma=0)
        ARMA(ar=2, ma=0, largest=4)
    """

    ar: Order = 1
    ma: Order = 1
    largest: int = 4

    def __post_init__(self) -> None:
        for name in ("ar", "ma"):
            order = getattr(self, name)
            if order != "auto":
                object.__setattr__(self, name, check_count(order, name, least=0))
        check_count(self.largest, "largest")

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Orders to choose from, smaller ones first."""
        ranges = [
            range(self.largest + 1) if order == "auto" else (order,) for order in (self.ar, self.ma)
        ]
        return sorted(
            ((p, q) for p in ranges[0] for q in ranges[1]), key=lambda one: (sum(one), one)
        )  # type: ignore[misc]

    @property
    def chooses(self) -> bool:
        """True where there are orders to choose."""
        return "auto" in (self.ar, self.ma)


@dataclass(frozen=True)
class Innovations:
    """Declaration: process noise and sensor noise of a motion, by the gain K of its predictor.

    The states follow `x̂_{k+1} = F(x̂_k, u_k) + K (y_k − h(x̂_k, u_k))`, and the criterion is the
    prediction error `y − h(x̂)`. K is estimated with the parameters and the learner.

    Examples:
        >>> Innovations()
        Innovations()
    """


Noise = ARMA | Innovations | Literal["white", "arma", "innovations", "auto"]


def declared_noise(noise: Any) -> ARMA | None:
    """Return the declaration of a noise model; None for white errors.

    Raises:
        InputError: what is no noise model, or one that lagged physics does not have.
    """
    if isinstance(noise, ARMA):
        return None if (noise.ar, noise.ma) == (0, 0) else noise
    known: dict[str, ARMA | None] = {"white": None, "arma": ARMA(), "auto": ARMA("auto", "auto")}
    if isinstance(noise, str) and noise in known:
        return known[noise]
    if isinstance(noise, Innovations) or noise == "innovations":
        raise InputError(f"`noise` = innovations {OF_MOTIONS}.")
    raise InputError(f"`noise` must be white, arma, auto or ARMA(…); got {show(noise)}.")


def noise_of_motion(noise: Any) -> Literal["white", "innovations", "auto"]:
    """Return the noise model of a motion, by its word.

    Raises:
        InputError: what is no noise model, or one that motions do not have.
    """
    if isinstance(noise, Innovations):
        return "innovations"
    if isinstance(noise, ARMA) or noise == "arma":
        raise InputError(f"`noise` = arma {OF_LAGGED}.")
    if noise in ("white", "innovations", "auto"):
        return noise
    raise InputError(
        f"`noise` must be white, innovations, auto or Innovations(); got {show(noise)}."
    )
