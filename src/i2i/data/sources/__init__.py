"""Sources of meshes behind one interface; each is chosen by ``_target_`` in ``conf/data/``.

The sources are imported where they are used (``i2i.data.sources.modelnet40`` and so on), so that
one source's optional needs do not burden the others.
"""

from i2i.data.sources.base import Z_SYMMETRIC_CLASSES, MeshItem, MeshSource

__all__ = ["Z_SYMMETRIC_CLASSES", "MeshItem", "MeshSource"]
