"""The first import of every module that computes with JAX: double precision, or a worded refusal."""

from __future__ import annotations

import os

from orthaug._base.errors import PrecisionError

if os.environ.get("JAX_ENABLE_X64", "").strip().lower() in {"0", "false", "f", "no", "n", "off"}:
    raise PrecisionError(
        "orthaug computes in double precision, but the environment has "
        f"JAX_ENABLE_X64={os.environ['JAX_ENABLE_X64']}. Unset it, or set it to 1."
    )

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)

__all__ = ["jax", "jnp", "use_compilation_cache"]


def use_compilation_cache() -> None:
    """Keep compiled programs between processes (the command line does; the library never on its own)."""
    import platformdirs

    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or platformdirs.user_cache_dir("orthaug")
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
