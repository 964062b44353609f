"""Six degrees of freedom of a spinning, rolling disc from two synchronised high-speed cameras."""
