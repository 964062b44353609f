"""Tools of both packages: array types, errors, arguments, least squares, compiled functions, grey and stuck pixels."""
