"""Tests of dots, poses and declared numbers for errors."""
