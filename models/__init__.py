"""p(x | I): from an image crop to 2D joints with a Convolutional Pose Machine."""
