"""The foundation: statuses, messages, static sizes, safe maths, staging."""

from ._checks import GeometryError as GeometryError
from ._checks import check_shape as check_shape
from ._checks import message as message
from ._components import components as components
from ._host import from_host as from_host
from ._host import host_zeros as host_zeros
from ._maths import eigen_two as eigen_two
from ._maths import masked_mean as masked_mean
from ._maths import prefix_sum as prefix_sum
from ._maths import safe_divide as safe_divide
from ._maths import safe_norm as safe_norm
from ._maths import safe_normalize as safe_normalize
from ._maths import tangents_to as tangents_to
from ._sizes import bucket as bucket
from ._stage import runtime_token as runtime_token
from ._stage import stage as stage
from ._status import RESULTS as RESULTS
from ._status import failure_where as failure_where
from ._status import first_failure as first_failure
from ._status import name_of as name_of
