"""A fixed design of crossings: few cases that together have every pair of levels of all of them."""

from itertools import combinations


def pairwise(cases):
    """Return a subset of the cases, in their order, in which each pair of levels of two factors occurs that occurs in all.

    A case is a tuple of one level per factor. The search is greedy: first the cases whose pairs are all new, then those
    with one old pair, and so on.
    """
    cases = list(cases)
    covered = set()
    chosen = set()
    for least in range(len(list(combinations(cases[0], 2))) if cases else 0, 0, -1):
        for case in cases:
            new = set(combinations(enumerate(case), 2)) - covered
            if len(new) >= least:
                covered |= new
                chosen.add(case)
    return [case for case in cases if case in chosen]
