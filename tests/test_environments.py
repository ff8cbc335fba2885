"""The page on environments says what the tests do."""

from tests import environments


def test_the_page_on_environments_is_the_one_that_the_kinds_and_the_records_make():
    assert environments.DOCUMENT.read_text(encoding="utf-8") == environments.document(), (
        "run python -m tests.environments"
    )


def test_every_record_is_of_an_environment_that_is_tried():
    assert environments.results().keys() <= environments.TRIED.keys()
