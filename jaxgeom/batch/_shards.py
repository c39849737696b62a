"""Which share of a manifest this process works on; no engine is needed for that."""

import hashlib

import equinox as eqx

from .._core import GeometryError, message


class Shard(eqx.Module):
    """Share `index` (from 0) of `count` shares, by a hash of the id of each scan.

    The share of a scan depends on its id alone, not on its line in the manifest.
    """

    index: int = eqx.field(static=True, default=0)
    count: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if not 0 <= self.index < self.count:
            raise _bad_shard(f"{self.index}/{self.count}")

    def holds(self, name: str) -> bool:
        """Whether the scan of this id belongs to the share."""
        digest = hashlib.sha256(name.encode()).digest()
        return int.from_bytes(digest[:8], "big") % self.count == self.index


def shard_of(text: str) -> Shard:
    """The share written as i/n, with i from 0 to n - 1."""
    index, slash, count = text.partition("/")
    if not (slash and index.isdecimal() and count.isdecimal()):
        raise _bad_shard(text)
    return Shard(int(index), int(count))


def shard_of_environment(variables) -> Shard:
    """The share that an array job of Slurm, Kubernetes or AWS Batch names.

    **Arguments:**

    - `variables`: a mapping such as `os.environ`. Read are SLURM_ARRAY_TASK_ID with
      _COUNT, _MIN and _MAX; JOB_COMPLETION_INDEX with JOB_COMPLETIONS, which the job's
      description must set; AWS_BATCH_JOB_ARRAY_INDEX with _SIZE.

    The whole manifest where none is set. Raises `GeometryError` for an index without
    its count, and for a Slurm array that does not run from 0 or 1 without gaps: it may
    be a part of the array that began the work, whose shares were others.
    """
    for index, count in _PAIRS:
        if index not in variables:
            continue
        if count not in variables:
            given = f"{index}={variables[index]} without {count}"
            raise _bad_shard(given)
        try:
            place, total = int(variables[index]), int(variables[count])
            if index.startswith("SLURM"):
                first = int(variables.get("SLURM_ARRAY_TASK_MIN", 0))
                last = int(variables.get("SLURM_ARRAY_TASK_MAX", first + total - 1))
                if first > 1 or last - first + 1 != total:
                    raise _bad_shard(f"a Slurm array of {total} from {first} to {last}")
                place = place - first
        except ValueError:
            given = f"{index}={variables[index]}, {count}={variables[count]}"
            raise _bad_shard(given) from None
        return Shard(place, total)
    return Shard()


_PAIRS = (
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"),
    ("JOB_COMPLETION_INDEX", "JOB_COMPLETIONS"),
    ("AWS_BATCH_JOB_ARRAY_INDEX", "AWS_BATCH_JOB_ARRAY_SIZE"),
)


def _bad_shard(given):
    must = "a shard must be i/n with i from 0 to n - 1"
    return GeometryError(message(must, given, "Pass --shard i/n, such as 0/8."))
