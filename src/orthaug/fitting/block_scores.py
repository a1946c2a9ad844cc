"""Scores of a free run in blocks of steps, for standard errors under coloured errors.

θ and weights p minimise a sum of squares, so that `p̂ − p ≈ M⁻¹ Σ_k s_kᵀe_k` with M the information
and s_k the sensitivities of step k. Coloured errors make the products s_kᵀe_k of neighbours
dependent. Batch means (Carlstein 1986) need no model of the colour: with B_j the sum over a block
of many steps, `Ω = Σ_j B_j B_jᵀ` estimates the covariance of the whole sum, and `M⁻¹ Ω M⁻¹` that of
p̂. To first order that is Newey and West's estimate with as many lags as a block has steps (Andrews
1991); in the words of cluster-robust errors (Liang and Zeger 1986) a block is a cluster.

The fit bends towards the errors of each block, the more so the fewer blocks there are for its
parameters, so that B_j is smaller than it would be at the true p. With M_j the information of the
block, `M (M − M_j)⁻¹ B_j` is its score at the fit without it: the jackknife over blocks (CR3 of
Bell and McCaffrey 2002), with `(J − 1)/J` in Ω.

The state that a segment starts from is an unknown too. It is eliminated from every step alike, with
χ_k the sensitivity to it: `s_k − S_px S_xx⁻¹ χ_k`, the Schur complement of M. That is linear in the
steps, so it can follow the sum over a block. What the measured state adds counts to the first block
of its segment. No block crosses the end of a segment.

A record that is too short for blocks may still show the colour by few numbers: with e an
autoregressive process of autocovariance γ, `Ω = Σ_jk s_jᵀ γ_{j−k} s_k`, for s follows the inputs
and not the noise (`fitting/colour.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError
from orthaug.data.record import Record
from orthaug.fitting.colour import autoregression, correlation_length
from orthaug.fitting.objective import errors_of
from orthaug.fitting.segments import Segments, begins_of, block_scores, packed, respond
from orthaug.inference.influence import LARGEST
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.statistics import Statistics, half_inverse

_MEMORIES = 3  # times as many steps in a block as the errors' correlation lasts
# Share of a direction's information that the other blocks hold at least. A block that determines
# a direction alone has no error along it, and nothing would be divided by nothing.
_LEFT = 0.1


@dataclass(frozen=True, eq=False)
class FreeRunScores:
    """A trained free run, whose scores of p = (c, w) can be summed over blocks.

    `slope` and `pull` are how the best states follow p and the measured states; None where the
    states are no unknowns. `unit` scales the information of p to the Gram matrix that the model
    keeps. `share` is how many times more was trained on than these segments, which are then a
    subsample of it.
    """

    dynamics: Dynamics
    numbers: Numbers
    segments: Segments
    states: Float[np.ndarray, "k n0 m"]
    weight: Matrix
    unit: float
    slope: Float[np.ndarray, "k m n0 n"] | None = None
    pull: Float[np.ndarray, "k m n0"] | None = None
    share: float = 1.0

    @property
    def followed(self) -> Float[np.ndarray, "k m n0 n"] | None:
        """Derivative of the best states by the unknowns of the fit, less its sign."""
        return self.slope

    @property
    def longest(self) -> int:
        """Scored steps of the longest segment."""
        return int(np.asarray(self.segments.scored).sum(axis=1).max())

    def errors(self) -> Float[np.ndarray, "ny s T"]:
        """Return the errors of each output by segments, those that are scored and measured first.

        Then zeros; in their places where nothing is missing.
        """
        errors = errors_of(self.dynamics, self.numbers, self.states, self.segments)
        errors = packed(errors, self.segments)
        return np.moveaxis(errors, 3, 1).reshape(-1, *errors.shape[1:3]).transpose(2, 0, 1)

    def block(self) -> int | None:
        """Return the steps of a block: three times the correlation length of the errors.

        At most those of a segment.

        None where the correlation has no end, or lasts longer than a segment.
        """
        lengths = [correlation_length(errors) for errors in self.errors()]
        known = [length for length in lengths if length is not None]
        if len(known) < len(lengths) or max(known) > self.longest:
            return None
        return min(_MEMORIES * max(known), self.longest)

    def blocks(self, steps: int) -> Float[np.ndarray, "b n"]:
        """Return the score of every block of about `steps` scored steps.

        No block is shorter where the segment has as many steps.
        """
        scored, place = np.asarray(self.segments.scored), self._places(steps)
        made = (self.dynamics, self.numbers, self.segments, self.states, self.weight)
        sums = np.moveaxis(
            np.asarray(block_scores(*made, place.astype(np.int32), int(place[-1]) + 1)), -1, 1
        )
        n0 = self.segments.start.shape[1]
        scores = sums[..., n0:]  # (k, m, b, n)
        if self.slope is not None and self.pull is not None:
            of_state = sums[..., :n0].copy()
            of_state[:, :, 0] += self.pull
            scores = scores - of_state @ self.slope
        counts = np.stack(
            [scored[:, place == block].sum(axis=1) for block in range(int(place[-1]) + 1)], axis=-1
        )
        return scores[counts > 0]

    def _places(self, steps: int) -> Int[np.ndarray, "T"]:
        """Return the block of each step of a segment, counted from 0."""
        first = int(np.argmax(np.asarray(self.segments.scored).any(axis=(0, 2))))
        count = max(self.longest // steps, 1)
        return np.maximum(np.arange(self.segments.steps) - first, 0) // -(-self.longest // count)

    def by_recording(self, record: Record, washout: int) -> Float[np.ndarray, "E n"] | None:
        """Return the score of every recording, in the units of the model's Gram matrix.

        None where the segments are not those of the record's experiments.

        Args:
            washout: leading steps of a segment that are not scored.
        """
        segments = self.blocks(self.longest)
        steps = self.segments.steps
        rows = [len(experiment) - self.dynamics.first_row for experiment in record.experiments]
        counts = [len(begins_of(count, steps, min(washout, steps - 1))) for count in rows]
        if sum(counts) != len(segments):
            counts = [1] * len(rows)  # whole experiments, or the first rows of each
        if sum(counts) != len(segments):
            return None
        owner = np.repeat(record.recordings, counts)
        found = np.zeros((owner[-1] + 1, segments.shape[1]))
        np.add.at(found, owner, segments)
        return self.share * self.unit * found

    def slopes(self) -> Float[np.ndarray, "N ny n"]:
        """Return the sensitivities of p on every complete step, the starts eliminated.

        In the units of the model's Gram matrix.

        They are the scores of errors of 1 in one whitened output after the other.
        """
        model = np.asarray(respond(self.dynamics, self.numbers, self.segments, self.states))
        there, n0 = np.moveaxis(self.segments.complete, -1, 1), self.segments.start.shape[1]
        place = np.arange(self.segments.steps, dtype=np.int32)
        found = []
        for unit in np.linalg.inv(self.weight).T:
            segments = self.segments._replace(target=model + unit[:, None])
            made = (
                self.dynamics,
                self.numbers,
                segments,
                self.states,
                self.weight,
                place,
                len(place),
            )
            sums = np.moveaxis(np.asarray(block_scores(*made)), -1, 1)  # (k, m, T, n0 + n)
            own = (
                sums[..., n0:]
                if self.slope is None
                else sums[..., n0:] - sums[..., :n0] @ self.slope
            )
            found.append(own[there])
        return np.sqrt(self.unit) * np.stack(found, axis=1)

    def whitened(self) -> Float[np.ndarray, "N ny"]:
        """Return the errors of the same steps in whitened outputs, in the same units."""
        errors = np.moveaxis(
            errors_of(self.dynamics, self.numbers, self.states, self.segments), 3, 1
        )  # (k, m, T, ny)
        there = errors[np.moveaxis(self.segments.complete, -1, 1)]
        return np.sqrt(self.unit) * there @ self.weight.T

    def middle(self, steps: int, used: float) -> tuple[Matrix, int]:
        """Return Ω of p in the units of the model's Gram matrix, and its number of blocks.

        Args:
            used: parameters of the fit, by which its errors are too small.
        """
        scores = self.unit * self.blocks(steps)
        blocks, rows = len(scores), self.share * float(self.segments.observations.sum())
        correction = blocks / max(blocks - 1, 1) * rows / max(rows - used, 1.0)
        return self.share * correction * scores.T @ scores, blocks

    def jackknife(
        self, steps: int, used: float, information: Matrix, moves: Bool[np.ndarray, "n"], nt: int
    ) -> tuple[Matrix, int]:
        """Return `middle` by the scores `M (M − M_j)⁻¹ B_j` of fits without their block.

        It is `middle` where the slopes do not fit into memory.

        Args:
            information: M of all of training, with the precisions of the prior, of the entries
                of p that move.
            moves: mask of these entries; a parameter at its bound is a constant to the others.
            nt: number of θ among them, the leading ones.
        """
        scores, grams = self.unit * self.blocks(steps), self._grams(steps, len(moves))
        blocks = len(scores)
        if grams is None or len(grams) != blocks:
            return self.middle(steps, used)
        # In coordinates where M is the identity, (M − M_j)⁻¹ divides by 1 − the eigenvalues of M_j
        half = half_inverse(information, nt)
        values, vectors = np.linalg.eigh(half.T @ grams[:, moves][:, :, moves] @ half)
        own = np.einsum("bri,br->bi", vectors, scores[:, moves] @ half)
        own /= np.maximum(1 - values, _LEFT)
        scores[:, moves] = np.einsum("bri,bi->br", vectors, own) @ (information @ half).T
        return self.share * (blocks - 1) / blocks * scores.T @ scores, blocks

    def _grams(self, steps: int, n: int) -> Float[np.ndarray, "b n n"] | None:
        """Return the information of each of `blocks`; None where it is too large for memory."""
        there = np.moveaxis(self.segments.complete, -1, 1)  # (k, m, T)
        place, ny = self._places(steps), self.segments.target.shape[2]
        segments, blocks = there.shape[0] * there.shape[1], int(place[-1]) + 1
        if n * max(there.size * ny, segments * blocks * n) > LARGEST:
            return None
        owner = np.arange(segments).reshape(*there.shape[:2], 1) * blocks + place
        ends = np.flatnonzero(np.diff(owner[there])) + 1
        parts = [part.reshape(-1, n) for part in np.split(self.slopes(), ends)]
        return np.stack([part.T @ part for part in parts])

    def coloured_middle(self, used: float) -> tuple[Matrix, float]:
        """Return Ω of p under autoregressive errors, and their independent number.

        In the units of the model's Gram matrix.

        Errors of several outputs are whitened against each other; each has a colour of its own.

        Args:
            used: parameters of the fit, by which its errors are too small.
        """
        lengths = self.segments.complete.sum(axis=1).ravel()
        ends = np.cumsum(lengths)[:-1]
        slopes, errors = np.split(self.slopes(), ends), np.split(self.whitened(), ends)
        outputs, rows = errors[0].shape[1], self.share * sum(lengths)
        share = self.share * self.segments.observations.sum() / max(outputs * sum(lengths), 1)
        total, independent = 0.0, np.inf
        for o in range(outputs):
            colour = autoregression([piece[:, o] for piece in errors if len(piece)])
            gamma = colour.autocovariance(max(lengths))
            for own in slopes:
                if len(own):
                    total = total + own[:, o].T @ scipy.linalg.matmul_toeplitz(
                        gamma[: len(own)], own[:, o]
                    )
            independent = min(independent, self.share * float(colour.independent(lengths)))
        correction = (
            rows
            * outputs
            / max(rows * outputs - used, 1.0)
            * independent
            / max(independent - 1.0, 1.0)
        )
        return share * correction * np.asarray(total), independent

    def robust(
        self,
        statistics: Statistics,
        freedom: float,
        used: float,
        steps: int | None,
        moving: Bool[np.ndarray, "np"],
        *,
        modelled: bool = False,
    ) -> Statistics:
        """Return the model's statistics for coloured errors, from blocks of `steps` steps.

        None for as many as `block` says.

        Args:
            statistics, freedom: of errors that are white.
            used: parameters of the fit.
            steps: of a block.
            moving: mask of the θ that are not at a bound; they are the leading entries of p.
            modelled: take the errors for an autoregressive process instead of blocks.

        Raises:
            InputError: errors that remember each other for too long.
        """
        if modelled:
            middle, independent = self.coloured_middle(used)
            return replace(
                statistics, middle=middle, freedom=float(min(freedom, max(independent - 1.0, 1.0)))
            )
        steps = self.block() if steps is None else steps
        if steps is None:
            raise InputError(
                "the errors of the free run are correlated over too many steps for blocks; use "
                "a longer record."
            )
        assert statistics.gram is not None
        weights = np.ones(len(statistics.gram) - len(moving), dtype=bool)
        moves, nt = np.concatenate([moving, weights]), int(moving.sum())
        information = statistics.among(moves, len(moving)).information(nt)
        middle, blocks = self.jackknife(steps, used, information, moves, nt)
        return replace(statistics, middle=middle, freedom=min(freedom, blocks - 1.0))
