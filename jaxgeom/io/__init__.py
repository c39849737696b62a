"""Files in and out: point clouds and triangle meshes, in double precision."""

from ._errors import FileError as FileError
from ._load import load_cloud as load_cloud
from ._load import load_mesh as load_mesh
from ._save import save_cloud as save_cloud
from ._save import save_mesh as save_mesh
from ._trimesh import from_trimesh as from_trimesh
from ._trimesh import to_trimesh as to_trimesh
from ._weights import load_weights as load_weights
from ._weights import save_weights as save_weights
