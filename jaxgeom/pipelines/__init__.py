"""The doors: whole pipelines, in a host form and a compiled form."""

from ._find_start import find_start as find_start
from ._fit_field import FittedField as FittedField
from ._fit_field import fit_field as fit_field
from ._fit_many import fit_many as fit_many
from ._fuse import Fusion as Fusion
from ._fuse import fuse as fuse
from ._iterated import IteratedPoisson as IteratedPoisson
from ._memory import memory_needed as memory_needed
from ._nonrigid_many import nonrigid_many as nonrigid_many
from ._prepare import prepare as prepare
from ._pyramid import Pyramid as Pyramid
from ._pyramid import choose_voxel_size as choose_voxel_size
from ._pyramid import level_rooms as level_rooms
from ._pyramid import without_sparse_levels as without_sparse_levels
from ._reconstruct import Reconstruction as Reconstruction
from ._reconstruct import reconstruct as reconstruct
from ._reconstruct import reconstruct_jit as reconstruct_jit
from ._reconstruct_many import reconstruct_many as reconstruct_many
from ._register import MeanAligned as MeanAligned
from ._register import register as register
from ._register import register_jit as register_jit
from ._register_many import SharedTarget as SharedTarget
from ._register_many import register_many as register_many
from ._register_many import share_target as share_target
from ._shape_as_points import ShapeAsPoints as ShapeAsPoints
from ._shape_as_points import shape_as_points as shape_as_points
