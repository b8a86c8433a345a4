"""Page of the app in the browser, made with Gradio: controls at the left, pictures and the script at the right."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kornia_tidy.cli.app.answers import PICTURES, Answer, answer
from kornia_tidy.cli.app.capture import Tell
from kornia_tidy.cli.app.guard import LARGEST_UPLOAD, Guard
from kornia_tidy.cli.app.settings import CONTROLS, SIDES, Control, Group, Settings, shown
from kornia_tidy.files import write_bytes
from kornia_tidy.search_path import missing

try:
    import fastapi  # ty: ignore[import-not-found]
    import gradio as gr  # ty: ignore[import-not-found]
    import uvicorn  # ty: ignore[import-not-found]
except ImportError as error:
    raise missing("gradio", "the app", error) from error

TITLE = "kornia_tidy: a camera with programmable phase masks"
INTRODUCTION = """\
# One exposure, several phase masks
The masks in the lens change while the shutter is open, so each depth leaves its own blur in the **capture**. From this
one picture a **reconstruction** gives the scene in focus everywhere, and a trained network its depth. Change anything.
"""
GROUPS: tuple[Group, ...] = ("scene", "painted scene", "files", "camera", "own camera", "painted depths", "capture")
ALTERNATIVES = {
    "scene": "the scene in focus",
    "capture": "the coded capture",
    "image": "the reconstructed image",
    "depth": "the depth of the scene in colours",
    "estimate": "the estimated depth in colours",
    "psfs": "masks and their point spread functions over depth",
}
STYLE = """
:root { --block-info-text-color: #6b7280; }
.legend { font-size: 0.9rem; margin-bottom: 0.5rem; }
#status { border-left: 4px solid #c2410c; padding-left: 0.8rem; min-height: 1.6rem; }
#intro h1 { font-size: 1.5rem; margin: 0 0 0.3rem 0; }
"""
THEME = gr.themes.Default(font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"])
CACHE = (3600, 86400)  # seconds: each hour uploaded files older than a day are removed


def make_page(tell: Tell, folder: Path) -> Any:
    """Return the page, with the result of the default settings on it.

    Args:
        tell: see :func:`~kornia_tidy.cli.app.capture.take_picture`.
        folder: for scripts that are downloaded.

    Returns:
        A ``gradio.Blocks``.
    """
    answer({"side": SIDES[0]})  # a system is loaded once; the time on the page is without it
    first = answer({}, tell)
    with gr.Blocks(title=TITLE, analytics_enabled=False, delete_cache=CACHE, fill_width=True) as page:
        gr.Markdown(INTRODUCTION, elem_id="intro")
        with gr.Row():
            with gr.Column(scale=1, min_width=330):
                inputs, groups = _controls()
            with gr.Column(scale=4, min_width=320):
                results = _results(first, folder)

        def show(*values: Any, progress: Any = gr.Progress()) -> list[Any]:  # noqa: B008 Gradio finds it as a default
            found = answer(dict(zip(inputs, values, strict=True)), lambda share, stage: progress(share, desc=stage))
            return updates(found, folder)

        gr.on(
            [control.change for control in inputs.values()],
            show,
            list(inputs.values()),
            results,
            show_progress_on=results[:1],
            trigger_mode="always_last",
            api_visibility="private",
        )
        deciding = [inputs[name] for name in ("scene", "camera", "stretch")]
        gr.on(
            [control.change for control in deciding],
            lambda *values: [gr.update(visible=shown(group, *values)) for group in groups],
            deciding,
            list(groups.values()),
            show_progress="hidden",
            api_visibility="private",
        )
    return page


def make_server(page: Any, folder: Path, hosts: Sequence[str] = ()) -> uvicorn.Server:
    """Return the server of a page.

    Args:
        page: from :func:`make_page`.
        folder: with all files of the page.
        hosts: see :class:`~kornia_tidy.cli.app.guard.Guard`.
    """
    application = gr.mount_gradio_app(
        fastapi.FastAPI(openapi_url=None),
        page,
        path="/",
        footer_links=[],
        theme=THEME,
        css=STYLE,
        max_file_size=LARGEST_UPLOAD,
        ssr_mode=False,
        run_history=False,  # which the browser could store with Hugging Face
    )
    # Open pages wait for messages, and would keep the server from ending.
    guard = Guard(application, folder, hosts)
    return uvicorn.Server(uvicorn.Config(guard, log_level="warning", timeout_graceful_shutdown=1))


def updates(found: Answer, folder: Path) -> list[Any]:
    """Return an answer as the updates of the components of :func:`_results`, in their order."""
    if not found.pictures:
        return [found.message, *[gr.skip()] * (2 * len(PICTURES) + 2)]
    pictures = [gr.update(value=found.pictures.get(name), visible=name in found.pictures) for name in PICTURES]
    words = [found.legends[name] for name in PICTURES]
    return [found.message, *pictures, *words, found.script, script_file(found.script, folder)]


def script_file(script: str, folder: Path) -> str:
    """Write a script to a file named ``capture.py`` in a separate folder, and return the path."""
    path = folder / hashlib.sha256(script.encode()).hexdigest()[:16] / "capture.py"
    path.parent.mkdir(exist_ok=True)
    write_bytes(path, script.encode())
    return str(path)


def _controls() -> tuple[dict[str, Any], dict[Group, Any]]:
    """Make the controls, and return them by name, and by name the groups that are shown and hidden."""
    inputs: dict[str, Any] = {}
    groups: dict[Group, Any] = {}

    def add(group: Group) -> None:
        inputs.update({control.name: _component(control) for control in CONTROLS if control.group == group})

    default = Settings()
    for group in GROUPS:
        with gr.Group(visible=shown(group, default.scene, default.camera, default.stretch)) as box:
            add(group)
        groups[group] = box
    with gr.Accordion("More", open=False):
        add("more")
    return inputs, groups


def _component(control: Control) -> Any:
    """Return the Gradio component of a control."""
    common: dict[str, Any] = {"label": control.label, "elem_id": control.name, "interactive": True}
    if control.kind == "file":
        return gr.File(**common, type="filepath", height=160)
    common |= {"info": control.info or None, "value": control.value}
    if control.kind == "choice":
        return gr.Dropdown(**common, choices=list(control.choices))
    if control.kind == "check":
        return gr.Checkbox(**common)
    limits = {"minimum": control.low, "maximum": control.high}
    if control.kind == "slider":
        box = gr.Slider(**common, **limits, step=control.step)
    else:
        box = gr.Number(**common, **limits, precision=0 if control.kind == "whole" else None)
    # Gradio would refuse an empty box or a number out of range before the settings are checked in a sentence.
    box.preprocess = lambda number: number
    return box


def _results(first: Answer, folder: Path) -> list[Any]:
    """Make the components that show an answer: message, pictures, legends, script and its file."""
    message = gr.Markdown(first.message, elem_id="status")
    pictures, words = {}, {}

    def add(name: str) -> None:
        pictures[name] = gr.Image(
            first.pictures.get(name),
            format="png",
            show_label=False,
            interactive=False,
            buttons=["download", "fullscreen"],
            alt_text=ALTERNATIVES[name],
            elem_id=f"picture-{name}",
        )
        words[name] = gr.Markdown(first.legends[name], elem_classes="legend", elem_id=f"legend-{name}")

    with gr.Row():
        for name in ("scene", "capture", "image"):
            with gr.Column(min_width=260):
                add(name)
    with gr.Row():
        with gr.Column(scale=1, min_width=260):
            add("depth")
            add("estimate")
        with gr.Column(scale=2, min_width=320):
            add("psfs")
    with gr.Accordion("The same in Python", open=False):
        script = gr.Code(first.script, language="python", show_label=False, elem_id="script")
    file = gr.DownloadButton("Save the settings as Python", value=script_file(first.script, folder), elem_id="save")
    return [message, *(pictures[name] for name in PICTURES), *(words[name] for name in PICTURES), script, file]
