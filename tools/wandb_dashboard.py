"""Build the project's dashboard on Weights & Biases: a saved view over the names in docs/monitoring.md.

    python tools/wandb_dashboard.py --entity TEAM --project facediff
    python tools/wandb_dashboard.py --entity TEAM --output dashboard.json    # no network, nothing saved

Needs the packages wandb and wandb-workspaces.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError
from facediff.models.evaluation import METHODS

if TYPE_CHECKING:
    from types import ModuleType

    from wandb_workspaces.workspaces import Workspace

STEP = "trainer/global_step"
TERMS = ("reconstruction", "velocity", "acceleration", "face", "style_identity")
METRICS = ("mve", "lve", "fdd", "fdd_absolute")
SPLITS = {"test_a": "test A, seen people", "test_b": "test B, unseen people"}
COLUMNS = (
    "config:model",
    "config:component/decoder",
    "config:component/style_encoder",
    "config:data/corpus",
    "config:protocol",
    "config:parameters/trainable",
    "summary:val/lve",
    "summary:test_a/lve",
    "summary:test_b/lve",
)


def build(entity: str, project: str, *, clips: Sequence[str] = (), terms: Sequence[str] = TERMS) -> Workspace:
    """The view, not saved yet.

    Args:
        entity: user or team that the project belongs to.
        project: the project.
        clips: clips whose preview videos get a panel each; all of them are in the table ``preview/clips`` anyhow.
        terms: terms of the loss beside ``loss``.
    """
    with warnings.catch_warnings():
        # wandb-workspaces uses an old form of pydantic's validators.
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            import wandb_workspaces.reports.v2 as panels
            import wandb_workspaces.workspaces as views
            from wandb_workspaces import expr
        except ModuleNotFoundError as error:
            raise FaceDiffError(
                f"the dashboard needs the package {error.name}, which is not installed: run  "
                f"pip install wandb wandb-workspaces"
            ) from error

    sections = panels_by_section(panels, clips, terms)
    return views.Workspace(
        entity=entity,
        project=project,
        name="facediff",
        sections=[views.Section(name=name, panels=content, is_open=True) for name, content in sections.items()],
        settings=views.WorkspaceSettings(x_axis=STEP),
        runset_settings=views.RunsetSettings(
            groupby=[expr.Config("data/corpus"), expr.Config("protocol")], pinned_columns=list(COLUMNS)
        ),
    )


def panels_by_section(panels: ModuleType, clips: Sequence[str], terms: Sequence[str]) -> dict[str, list[Any]]:
    """The panels of the view by the name of their section.

    Args:
        panels: the module that has the kinds of panels.
        clips: clips whose preview videos get a panel each.
        terms: terms of the loss beside ``loss``.
    """

    def line(title: str, *names: str, **options: Any) -> Any:  # noqa: ANN401
        return panels.LinePlot(title=title, x=STEP, y=list(names), **options)

    return {
        "Losses": [line(term, f"train/{term}", f"val/{term}", log_y=True) for term in ("loss", *terms)],
        "Metrics": [line(f"validation {metric}", f"val/{metric}") for metric in ("energy", *METRICS)],
        "Optimisation": [
            line("learning rate", "lr-AdamW"),
            line("gradient norm before clipping", "gradient/norm", log_y=True),
            line("gradient norm by component", metric_regex="gradient/.*", log_y=True),
        ],
        "Throughput": [
            line("clips a second", "train/device/samples_per_sec", "train/samples_per_sec"),
            line("batches a second", "train/device/batches_per_sec", "train/batches_per_sec"),
            line("clips seen", "train/samples"),
            line("training time, seconds", "train/time"),
        ],
        "Previews": [
            panels.WeavePanelSummaryTable(table_name="preview/clips"),
            *(panels.MediaBrowser(title=clip, media_keys=[f"preview/{clip}"]) for clip in clips),
            line("seconds a preview took", "preview/seconds"),
        ],
        "Test": [
            *(
                panels.BarPlot(
                    title=f"{metric}, {words}",
                    metrics=[f"{split}/{'' if name == 'model' else f'{name}/'}{metric}" for name in METHODS],
                )
                for split, words in SPLITS.items()
                for metric in METRICS
            ),
            panels.WeavePanelSummaryTable(table_name="test/sequences"),
        ],
    }


def as_json(view: Workspace) -> str:
    """The view as it would be sent; wandb-workspaces has no public way to say it."""
    return json.dumps(view._to_model().model_dump(mode="json", by_alias=True, exclude_none=True), indent=2)


def save(view: Workspace) -> str:
    """Save the view as a new one and give its address.

    Raises:
        FaceDiffError: if there is no key or no answer, or the server refuses.
    """
    os.environ.setdefault("WANDB_SILENT", "true")
    try:
        return str(view.save().url)
    except Exception as error:  # wandb raises errors of its own, of its transport and of requests
        raise FaceDiffError(
            f"the dashboard of {view.entity}/{view.project} was not saved: wandb refuses ({error}); --output FILE "
            f"writes its JSON without a network"
        ) from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--entity", required=True, help="user or team on Weights & Biases")
    parser.add_argument("--project", default="facediff", help="project; default: facediff")
    parser.add_argument("--clips", nargs="+", default=[], metavar="CLIP", help="clips whose preview videos get a panel")
    parser.add_argument("--terms", nargs="+", default=TERMS, metavar="TERM", help="terms of the loss, for other models")
    parser.add_argument("--output", type=Path, help="write the view's JSON to a file; no network, nothing saved")
    options = parser.parse_args(arguments)
    try:
        view = build(options.entity, options.project, clips=options.clips, terms=options.terms)
        if options.output is not None:
            from facediff.utils.files import atomic

            with atomic(options.output) as temporary:
                temporary.write_text(as_json(view) + "\n", encoding="utf-8")
            print(f"written: {options.output}", file=sys.stderr)
        if options.output is None:
            print(f"saved: {save(view)}")
    except FaceDiffError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
