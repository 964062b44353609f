"""Six degrees of freedom of a spinning, rolling disc from two synchronised high-speed cameras."""

__version__ = "0.1.0"
