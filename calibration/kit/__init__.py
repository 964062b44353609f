"""Tools of both packages: types, errors, least squares, compiled functions, grey and stuck pixels."""
