"""The paper's own network from its Caffe files, without Caffe: see :mod:`models.caffe.importer`."""

from models.caffe.importer import JOINT_ORDERS, LICENCE, JointOrder, import_caffe

__all__ = ["JOINT_ORDERS", "LICENCE", "JointOrder", "import_caffe"]
