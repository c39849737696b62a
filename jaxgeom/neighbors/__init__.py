"""Exact nearest neighbors among points and on triangle meshes."""

from ._backends import AbstractIndex as AbstractIndex
from ._brute import BruteForce as BruteForce
from ._brute import BruteIndex as BruteIndex
from ._cells import CellIndex as CellIndex
from ._cells import CellList as CellList
from ._knn import Neighbors as Neighbors
from ._knn import build as build
from ._knn import knn as knn
from ._surface import ClosestPoint as ClosestPoint
from ._surface import closest_on_mesh as closest_on_mesh
