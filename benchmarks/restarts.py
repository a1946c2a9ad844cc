"""Four restarts one after another, in threads, and batched by `vmap`: which is faster on this machine?

Run: python benchmarks/restarts.py
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

from machine import alternate, describe

from orthaug import MLP, LevenbergMarquardt
from orthaug._base.jax import jax, jnp
from orthaug.fitting.normal_equations import Hold, OneStep
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.solvers.compiled import Options, _advance, _first_state, linearise
from orthaug.fitting.solvers.damped_step import IDENTITY
from orthaug.models.rows import Overlap
from orthaug.physics.problem import pose
from orthaug.studies import synthetic

SEEDS, ITERATIONS = range(4), 100


def main() -> None:
    print(describe())
    print(
        "| example | loop | threads | loop / threads | vmap | loop / vmap "
        "|\n|---|---|---|---|---|---|"
    )
    solver = LevenbergMarquardt(ITERATIONS, tolerance=0.0)
    for name, example in (
        ("static", synthetic.static(1, noise=True)),
        ("mass-spring-damper", synthetic.mass_spring_damper()),
    ):
        task = OneStepTask.of(pose(example.train, example.baseline), MLP())
        starts = [task.bound.init(jax.random.key(seed)) for seed in SEEDS]
        nt = task.rows.q.shape[2]
        arguments = (task.rows, Hold(jnp.zeros((nt, nt)), jnp.zeros(nt)))
        overlap = Overlap(jnp.zeros((nt, task.bound.size)), jnp.zeros(nt))
        options = Options(jnp.asarray(0.0), jnp.asarray(False), jnp.asarray(1.0))
        criterion = OneStep(task.bound)

        @jax.jit
        def batched(
            ws: object, criterion=criterion, arguments=arguments, overlap=overlap, options=options
        ) -> object:
            def one(w: object) -> object:
                state = _first_state(
                    w, linearise(criterion, w, arguments, overlap), jnp.asarray(0.0), IDENTITY
                )
                return _advance(
                    criterion, IDENTITY, state, arguments, options, jnp.asarray(ITERATIONS)
                )

            return jax.vmap(one)(ws)  # noqa: B023

        def loop(task: OneStepTask = task, starts: list = starts) -> None:
            for w in starts:
                task.run(solver, w)

        def threads(task: OneStepTask = task, starts: list = starts) -> None:
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                list(pool.map(lambda w: task.run(solver, w), starts))

        stacked = jnp.stack(starts)
        one, two = alternate(loop, threads, 7)
        again, three = alternate(loop, lambda s=stacked, b=batched: jax.block_until_ready(b(s)), 7)
        print(
            f"| {name} | {one:.3f} s | {two:.3f} s | {one / two:.2f} | {three:.3f} s | "
            f"{again / three:.2f} |"
        )


if __name__ == "__main__":
    main()
