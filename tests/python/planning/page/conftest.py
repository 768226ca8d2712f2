"""The planning model of one coarse head and its page: built once for all tests here."""

import pytest
from planning_steps import settle

import cmfsim
import cmfsim.planning.page.content
from browser_page import open_page
from planning_head import planning_patient


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("planning")


@pytest.fixture(scope="session")
def bare(folder, tmp_path_factory):
    return cmfsim.planning_model(planning_patient(folder / "case", tmp_path_factory), "H+S")


@pytest.fixture(scope="session")
def planning(bare):
    """With a correction, which the page must evaluate as Python does."""
    corrected = cmfsim.corrected_planning(bare, 24)
    assert corrected.correction is not None
    return corrected


@pytest.fixture(scope="session")
def reference(planning):
    return planning.solve(planning.reference)


@pytest.fixture(scope="session")
def errors(planning):
    return cmfsim.expected_error(planning, trials=2)


@pytest.fixture(scope="session")
def content(planning, reference, errors):
    """Drawn with few triangles: browsers here draw by software."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cmfsim.planning.page.content, "FACE_TRIANGLES", 10_000)
        patch.setattr(cmfsim.planning.page.content, "BONE_TRIANGLES", 6_000)
        return cmfsim.page_content(planning, reference, errors)


@pytest.fixture(scope="session")
def page_file(folder, content):
    path = folder / "plan.html"
    cmfsim.write_planning_page(path, content)
    return path


@pytest.fixture(scope="module")
def page(browser, page_file):
    """One page for all tests; in the end it must have had no error and asked for nothing."""
    yield from open_page(browser, page_file)


@pytest.fixture
def opened(page):
    """The page as it was when it was opened."""
    page.evaluate("() => { cmfsimPage.reset(); cmfsimPage.plans.past.length = 0; }")
    page.evaluate("cmfsimPage.panel.choose(0)")
    page.locator("#turns-about").select_option("0")
    settle(page)
    return page
