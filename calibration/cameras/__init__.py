"""The camera model and the stereo pair: projection with derivatives, causes of uncertainty, lens field."""
