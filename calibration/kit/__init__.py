"""What every module here and in disctrack uses: array types, errors, short views of results, grey and stuck pixels."""
