"""What several tests share."""

from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

import sasmap
from sasmap.run.pipeline import run_survey

SAMPLE = Path(__file__).resolve().parents[1] / "sample_data"


# tests run side by side: threads of linear algebra would wait for each other
threadpool_limits(1, user_api="blas")


@pytest.fixture(scope="session")
def sample(tmp_path_factory):
    """The sample survey, run once with two workers."""
    output = tmp_path_factory.mktemp("sample")
    survey = sasmap.load_survey(SAMPLE / "survey.yaml")
    return output, run_survey(survey, output=output, workers=2)
