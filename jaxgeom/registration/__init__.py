"""Alignment of point clouds: features, matching, and consensus among wrong pairs."""

from ._deformation import AbstractDeformation as AbstractDeformation
from ._features import Matches as Matches
from ._features import fpfh as fpfh
from ._features import match_features as match_features
from ._global import GlobalStart as GlobalStart
from ._global import View as View
from ._global import align_features as align_features
from ._global import align_views as align_views
from ._global import describe_view as describe_view
from ._gnc import gnc as gnc
from ._gnc import robust_procrustes as robust_procrustes
from ._graph import EmbeddedGraph as EmbeddedGraph
from ._multiview import MultiView as MultiView
from ._multiview import multiview as multiview
from ._nonrigid import Deformed as Deformed
from ._nonrigid import Landmarks as Landmarks
from ._nonrigid import nonrigid as nonrigid
from ._ransac import Consensus as Consensus
from ._ransac import ransac as ransac
from ._stiffness import AsRigidAsPossible as AsRigidAsPossible
from ._stiffness import PerVertexAffine as PerVertexAffine
from ._stiffness import StiffnessSchedule as StiffnessSchedule
from ._viewgraph import Poses as Poses
from ._viewgraph import ViewGraph as ViewGraph
from ._viewgraph import match_views as match_views
from ._viewgraph import spanning_poses as spanning_poses
