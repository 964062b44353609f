"""The camera model and the pair of cameras: projection with derivatives, causes of uncertainty, foreign files."""
