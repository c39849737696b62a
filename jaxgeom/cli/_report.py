"""What a run says of itself: lines on stderr, and a JSON report."""

import contextlib
import json
import os
import pathlib
import platform
import sys
import threading
import time

import jax
import numpy as np

from .. import RESULTS, Reconstruction, __version__

_PATIENCE = 2.0  # seconds of silence before a stage says that it is at work


class Stages:
    """Times the stages of a run; one that takes over two seconds says so meanwhile."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def stage(self, name: str):
        """Time one stage under its name."""
        start = time.perf_counter()
        progress = threading.Timer(_PATIENCE, _tell, (f"{name} ...",))
        progress.daemon = True
        progress.start()
        try:
            yield
        finally:
            progress.cancel()
        self.seconds[name] = round(time.perf_counter() - start, 3)
        if self.seconds[name] > _PATIENCE:
            _tell(f"{name}: {self.seconds[name]:.1f} s")


def _tell(text: str) -> None:
    print(f"jaxgeom: {text}", file=sys.stderr, flush=True)


def mesh_facts(out: Reconstruction) -> dict:
    """The sizes and the checks of a reconstructed mesh."""
    check = out.topology
    facts = {name: getattr(check, name).item() for name in check.__dataclass_fields__}
    return {
        "vertices": len(out.mesh.vertices),
        "faces": len(out.mesh.faces),
        "watertight": bool(facts["is_closed"] and facts["is_manifold"]),
        **facts,
    }


def solver_facts(out: Reconstruction) -> dict:
    """The resolved parameters and the state of the solver."""
    stats = out.stats
    return {
        "screening": float(stats.screening),
        "noise": float(stats.noise),
        "level": float(out.field.level),
        "cg_steps": int(stats.steps),
        "cg_residual": float(stats.residual),
        "num_ignored": int(stats.num_ignored),
        "grid": list(out.field.grid.shape),
        "spacing": np.asarray(out.field.grid.spacing).tolist(),
    }


def status_of(out: Reconstruction) -> str:
    """`ok`, or the sentence of the status."""
    if bool(out.result == RESULTS.successful):
        return "ok"
    return RESULTS[out.result]


def write_report(path, **sections) -> None:
    """Write sections and the versions as JSON, whole or not at all."""
    sections["versions"] = {
        "jaxgeom": __version__,
        "jax": jax.__version__,
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
    }
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".tmp")
    partial.write_text(json.dumps({"schema": 1, **sections}, indent=2) + "\n")
    os.replace(partial, path)


def say(text: str) -> None:
    """One line of the result, for people, on stdout."""
    print(text, flush=True)
