# SPDX-License-Identifier: Apache-2.0
"""The annotation tool's web application: one page, the folder's images, and the annotations.

It answers only this machine's browser: requests under another host name (DNS rebinding) or from another site's page
are refused, and only files that were listed at the start can be named.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from flask import Flask, Response, jsonify, request
from werkzeug.exceptions import HTTPException

from flowing_puppet_ros.annotate import puppets
from flowing_puppet_ros.annotate.folder import ImageFolder
from flowing_puppet_ros.annotate.store import GENDERS, VIEWS, AnnotationStore, ConflictError, check_people
from flowing_puppet_ros.draw.palette import joint_colour, part_colours
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource

MAX_REQUEST_BYTES = 1_000_000  # of a body
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; frame-ancestors 'none'; form-action 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def make_app(
    folder: ImageFolder,
    store: AnnotationStore,
    parts: int,
    hosts: tuple[str, ...],
    networks: KeypointSource | None = None,
) -> Flask:
    """Build the application for a folder and its annotations.

    Args:
        folder: the images.
        store: their annotations.
        parts: of the puppets, 10 or 14.
        hosts: names (host:port) that requests may use.
        networks: find people as a first guess; without them the package's own detector does.
    """
    app = Flask(__name__, static_folder="page", static_url_path="/page")
    app.config["MAX_CONTENT_LENGTH"] = MAX_REQUEST_BYTES
    _guard(app, hosts)
    _serve_pages(app, folder, store, parts)
    _serve_puppets(app, folder, store, parts, networks)
    return app


def _guard(app: Flask, hosts: tuple[str, ...]) -> None:
    @app.before_request
    def refuse_strangers() -> tuple[Response, int] | None:
        origin = request.headers.get("Origin")
        same = request.headers.get("Sec-Fetch-Site", "same-origin") in ("same-origin", "none")
        if request.host not in hosts or not same or (origin and origin.partition("://")[2] not in hosts):
            return jsonify(error="the annotation tool only answers its own page"), 403
        return None

    @app.after_request
    def harden(response: Response) -> Response:
        response.headers.update(HEADERS)
        return response

    @app.errorhandler(PuppetError)
    def explain(error: PuppetError) -> tuple[Response, int]:
        status = 409 if isinstance(error, ConflictError) else 400 if isinstance(error, InputError) else 500
        return jsonify(error=str(error)), status

    @app.errorhandler(HTTPException)
    def explain_http(error: HTTPException) -> tuple[Response, int]:
        return jsonify(error=error.description), error.code or 500


def _serve_pages(app: Flask, folder: ImageFolder, store: AnnotationStore, parts: int) -> None:
    model = puppets.load_model("neutral", parts)

    @app.get("/")
    def page() -> Response:
        return app.send_static_file("index.html")

    @app.get("/api/folder")
    def listing() -> Response:
        bones = [[int(a), int(b)] for a, b in model.bone]
        return jsonify(
            name=folder.root.name,
            items=folder.items,
            counts=store.count_people(),
            joint_names=model.joint_names,
            joint_colours=[joint_colour(name) for name in model.joint_names],
            bones=bones,
            part_colours=dict(zip(model.tree.names, part_colours(model.tree.names).tolist(), strict=True)),
            genders=GENDERS,
            views=VIEWS,
        )

    @app.get("/api/image")
    def image() -> Response:
        return Response(folder.encode_jpeg(request.args.get("key", "")), mimetype="image/jpeg")

    @app.get("/api/export/json")
    def export_json() -> Response:
        return _make_download(store.path.read_bytes() if store.path.exists() else b"{}", "annotations.json")

    @app.get("/api/export/sticks")
    def export_sticks() -> Response:
        with TemporaryDirectory() as place:
            path = Path(place) / "sticks.txt"
            store.write_sticks(path, folder.items)
            return _make_download(path.read_bytes(), "sticks.txt")


def _serve_puppets(
    app: Flask, folder: ImageFolder, store: AnnotationStore, parts: int, networks: KeypointSource | None
) -> None:
    @app.get("/api/annotation")
    def annotation() -> Response:
        key = _check_key(folder, request.args.get("key", ""))
        revision, people = store.get(key)
        height, width = folder.load_image(key).shape[:2]
        return jsonify(revision=revision, size=[width, height], people=people)

    @app.get("/api/revision")
    def revision() -> Response:
        return jsonify(revision=store.get(_check_key(folder, request.args.get("key", "")))[0])

    @app.put("/api/annotation")
    def save() -> Response:
        given = _request_object()
        key, revision = _check_key(folder, given.get("key")), given.get("revision")
        if not isinstance(revision, int):
            raise InputError("the revision must be a whole number")
        return jsonify(revision=store.put(key, revision, given.get("people")))

    @app.post("/api/outline")
    def outline() -> Response:
        (person,) = check_people([_request_object().get("person")], len(store.joint_names))
        return jsonify(puppets.draw_outline(parts, person))

    @app.post("/api/new")
    def new() -> Response:
        given = _request_object()
        height, width = folder.load_image(_check_key(folder, given.get("key"))).shape[:2]
        gender, view = given.get("gender"), given.get("view")
        if gender not in GENDERS or view not in VIEWS:
            raise InputError(f"there is no puppet {gender!r} seen from {view!r}")
        return jsonify(puppets.make_person(parts, gender, view, (width, height)))

    @app.post("/api/find")
    def find() -> Response:
        image = folder.load_image(_check_key(folder, _request_object().get("key")))
        people = puppets.find_people(parts, image, networks)
        if not people:
            raise InputError("nobody is found in this image: add a puppet by hand")
        return jsonify(people=people)

    @app.post("/api/carry")
    def carry() -> Response:
        key = _check_key(folder, _request_object().get("key"))
        previous = folder.previous(key)
        if previous is None:
            raise InputError("this is the first image; there is none to copy from")
        people = store.get(previous)[1]
        if not people:
            raise InputError("no one is annotated in the previous image")
        return jsonify(
            people=puppets.propagate_people(parts, people, folder.load_image(previous), folder.load_image(key))
        )


def _request_object() -> dict[str, Any]:
    given = request.get_json()
    if not isinstance(given, dict):
        raise InputError("the request's body must be a JSON object")
    return given


def _check_key(folder: ImageFolder, key: object) -> str:
    if not isinstance(key, str) or key not in folder:
        raise InputError(f"{str(key)[:200]!r} is not an image of this folder")
    return key


def _make_download(data: bytes, name: str) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(data, mimetype="application/octet-stream", headers=headers)
