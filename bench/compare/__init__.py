"""Compares two sets of results cell by cell: did something get worse?"""
