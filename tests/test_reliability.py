"""The page on faults says what the tests do."""

import ast

from tests import reliability


def test_the_page_on_faults_is_the_one_that_the_marks_of_the_tests_make():
    assert reliability.DOCUMENT.read_text(encoding="utf-8") == reliability.document(), "run python -m tests.reliability"


def test_every_fault_has_a_test_and_every_mark_names_a_fault():
    faults = [fault for group in reliability.FAULTS.values() for fault in group]
    assert len(faults) == len(set(faults))
    assert set(reliability.marked()) == set(faults)


def test_a_mark_is_found_wherever_it_stands_among_the_decorators():
    source = '@pytest.mark.fault("a", "b")\n@pytest.mark.long\n@pytest.mark.fault("c")\ndef test_it(): pass'
    function = ast.parse(source).body[0]
    assert isinstance(function, ast.FunctionDef)
    assert list(reliability._faults_of(function)) == ["a", "b", "c"]
