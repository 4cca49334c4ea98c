"""A design of crossings has each pair of levels at least once, and few cases."""

from itertools import combinations, product

from pairwise import pairwise


def test_each_possible_pair_occurs_in_few_cases():
    cases = [case for case in product(range(30), "abcdef", range(9)) if case[0] % 9 != case[2]]
    design = pairwise(cases)
    assert set(design) <= set(cases)
    assert pairs(design) == pairs(cases)
    assert len(design) < len(cases) / 4


def pairs(cases):
    return {pair for case in cases for pair in combinations(enumerate(case), 2)}
