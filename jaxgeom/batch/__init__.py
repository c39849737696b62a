"""Many scans, named by a manifest: shards, one status file each, resumed reruns."""

from ._collect import collect as collect
from ._collect import count as count
from ._dask import client_at as client_at
from ._dask import local_client as local_client
from ._manifest import Scan as Scan
from ._manifest import read_manifest as read_manifest
from ._reconstructing import Reconstructing as Reconstructing
from ._registering import Registering as Registering
from ._run import run_batch as run_batch
from ._shards import Shard as Shard
from ._shards import shard_of as shard_of
from ._shards import shard_of_environment as shard_of_environment
from ._states import STATES as STATES
from ._warmup import warm_up as warm_up
