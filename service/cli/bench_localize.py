"""`splatfix bench localize`: accuracy and time on the test photos of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from service.cli.bench_output import measuring, report_figures
from service.cli.terminal import JsonFileOption, MatcherOption, parsed_option, settings_of


def bench_localize(
    folder: Annotated[Path, typer.Argument(help="A scene folder with test photos and their poses, or a scene file.")],
    data: Annotated[Path | None, typer.Option(help="The data set's folder, if it isn't the scene's.")] = None,
    layout: Annotated[
        str, typer.Option(help="auto, nerf_synthetic, llff, mipnerf360, deep_blending, nerfstudio or scene.")
    ] = "auto",
    background: Annotated[Literal["scene", "white", "black"], typer.Option()] = "scene",
    estimator: str = "view_index",
    matcher: MatcherOption = "",
    start: Annotated[str, typer.Option(help="none, near, easy, hard, pnerf, inplace or random.")] = "none",
    trials: Annotated[int, typer.Option(min=1, help="Start poses per photo.")] = 1,
    seed: int = 0,
    intrinsics: Annotated[Literal["given", "approximate", "withheld"], typer.Option()] = "given",
    cameras: Annotated[Literal["given", "ignored"], typer.Option()] = "given",
    modify: Annotated[list[str] | None, typer.Option(help="NAME=VALUE; may be repeated.")] = None,
    modify_scene: Annotated[list[str] | None, typer.Option(help="NAME=VALUE; may be repeated.")] = None,
    occluders: Annotated[Path | None, typer.Option(help="Photos of another scene, for `--modify occlusion`.")] = None,
    options: Annotated[str, typer.Option(help="The estimator's, as JSON or a file of it.")] = "",
    accuracy: Annotated[str, typer.Option(help="Asked for with each photo, as `localize` takes it.")] = "",
    budget_s: Annotated[float | None, typer.Option(help="Time limit per photo, seconds.")] = None,
    budget_renders: Annotated[int | None, typer.Option(help="Limit of renders per photo.", min=1)] = None,
    photos: Annotated[bool, typer.Option("--photos", help="With a digest of the training photos.")] = False,
    misses: Annotated[Path | None, typer.Option(help="A folder for an image of each miss at 1 deg, 0.01.")] = None,
    json_file: JsonFileOption = None,
) -> None:
    """Localize a scene's test photos and compare with the truth."""
    from service.bench import miss_images
    from service.bench.localize import Budget, run
    from service.loaded_scene import DEFAULT_MATCHER
    from service.web.schemas.job_spec import accuracy_from, options_from

    with measuring("photos") as progress:
        outcome = run(
            folder,
            data=data,
            layout=layout,
            background=background,
            estimator=estimator,
            matcher=matcher or DEFAULT_MATCHER,
            start=start,
            trials=trials,
            seed=seed,
            intrinsics=intrinsics,
            cameras=cameras,
            modify=tuple(modify or ()),
            modify_scene=tuple(modify_scene or ()),
            occluders=occluders,
            options=options_from(estimator, parsed_option(options, "options") or {}),
            budget=Budget(budget_s, budget_renders),
            accuracy=accuracy_from(parsed_option(accuracy, "accuracy")),
            progress=progress,
            cache_dir=settings_of({}).cache_dir,
            photos=photos,
            on_miss=miss_images.save_miss_images(misses) if misses else None,
        )
    report_figures(outcome, json_file, rows="per_query")
