"""Where the dots are: in one image, and without any prior in two."""
