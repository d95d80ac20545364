"""User studies: videos of methods side by side, a page of questions for raters, and the analysis of their answers.

From top to bottom: :func:`plan_study` reads and checks animations and makes a :class:`StudyPlan`, whose ``make`` writes
the study's folder; :func:`serve` hands the page out and stores answers; :func:`analyse_folder` makes a
:class:`StudyReport` of them. Names are loaded on first use.
"""

from typing import TYPE_CHECKING

from facediff.utils.lazy import lazy_names

if TYPE_CHECKING:
    from facediff.study.analysis import StudyReport as StudyReport
    from facediff.study.analysis import analyse as analyse
    from facediff.study.analysis import analyse_folder as analyse_folder
    from facediff.study.definition import Study as Study
    from facediff.study.definition import read_study as read_study
    from facediff.study.making import StudyPlan as StudyPlan
    from facediff.study.making import plan_study as plan_study
    from facediff.study.options import StudyOptions as StudyOptions
    from facediff.study.server import serve as serve

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "analysis": "StudyReport analyse analyse_folder",
        "definition": "Study read_study",
        "making": "StudyPlan plan_study",
        "options": "StudyOptions",
        "server": "serve",
    },
)
