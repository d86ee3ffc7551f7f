"""What can go wrong with a model file."""


class ModelError(Exception):
    """A model or its card is missing, corrupt or of the wrong kind; names the file and the mend."""


class AnnotationError(ModelError):
    """A user's labelled images cannot be trained on; names the file, the record and the mend."""


class CaffeError(ModelError):
    """A prototxt or caffemodel is not one, or not of a network that can be imported."""
