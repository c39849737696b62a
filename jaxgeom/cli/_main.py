"""Exit codes and messages; the work is done in the modules beside.

This file imports neither JAX nor trimesh, so that help and usage errors are immediate.
"""

import contextlib
import importlib
import os
import sys

from ._parser import parser

OK, INTERNAL, USAGE, FILE, DATA, CHECK, SOME, INTERRUPTED = 0, 1, 2, 3, 4, 5, 6, 130

# Commands whose work is divided among devices.
_BATCHES = ("batch", "register_many", "warmup")


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = parser().parse_args(argv)
    name = arguments.command.replace("-", "_")
    module = importlib.import_module(f"._{name}", __package__)
    _use_compile_cache()
    if name in _BATCHES:
        _use_every_core()
    from .._core import GeometryError
    from ..io import FileError

    try:
        return module.run(arguments)
    except FileError as error:
        return _complain(error, FILE)
    except OSError as error:
        return _complain(error, FILE)
    except GeometryError as error:
        return _complain(error, DATA)
    except KeyboardInterrupt:
        return _complain("interrupted; no output was replaced", INTERRUPTED)
    except Exception as error:
        if arguments.verbose:
            raise
        text = f"internal error: {type(error).__name__}: {error}. Run again with -v."
        return _complain(text, INTERNAL)


def _complain(error, code):
    print(f"jaxgeom: error: {error}", file=sys.stderr)
    return code


def _use_every_core():
    """One CPU device per core, which share a batch; what was asked for stays."""
    import jax

    asked = "host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if not asked and jax.config.jax_num_cpu_devices == -1:
        # Not every system tells which cores this process may use.
        own = getattr(os, "sched_getaffinity", None)
        count = len(own(0)) if own else os.cpu_count()
        # A process that has computed already keeps its devices.
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", count)


def _use_compile_cache():
    """Keep compiled programs in the user's cache folder between runs."""
    import jax

    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if jax.config.jax_compilation_cache_dir is None:
        folder = os.path.join(base, "jaxgeom", "compiled")
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
