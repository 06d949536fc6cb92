"""articugen: articulated URDF models in, training data for part decomposition out."""

__version__ = "0.1.0"
