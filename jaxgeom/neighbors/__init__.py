"""Exact nearest neighbors among points and on triangle meshes."""

from ._backends import AbstractBackend as AbstractBackend
from ._backends import AbstractIndex as AbstractIndex
from ._brute import BruteForce as BruteForce
from ._brute import BruteIndex as BruteIndex
from ._cells import CellIndex as CellIndex
from ._cells import CellList as CellList
from ._host import HostIndex as HostIndex
from ._host import HostTree as HostTree
from ._knn import Neighbors as Neighbors
from ._knn import build as build
from ._knn import knn as knn
from ._rays import RayHits as RayHits
from ._rays import cast_rays as cast_rays
from ._signed import AbstractSign as AbstractSign
from ._signed import Pseudonormal as Pseudonormal
from ._signed import SignedDistance as SignedDistance
from ._signed import Winding as Winding
from ._signed import signed_distance as signed_distance
from ._surface import ClosestPoint as ClosestPoint
from ._surface import SurfaceIndex as SurfaceIndex
from ._surface import closest_on_mesh as closest_on_mesh
from ._surface import index_surface as index_surface
from ._winding import Exact as Exact
from ._winding import Hierarchical as Hierarchical
from ._winding import inside as inside
from ._winding import winding_number as winding_number
