"""The client and a real service: every endpoint, errors, keys, a crowd."""

from __future__ import annotations

import io
import json
from pathlib import Path

import anyio
import pytest
from posematch_client import AsyncClient, Client, RefusedError, Retries, UnreachableError

from app import schemas
from tests.app.conftest import API_KEY, RENDERS, Render
from tests.app.server import Server, free_port

ROOT = Path(__file__).parents[2]
PATIENT = Retries(deadline_s=120.0, attempts=200)


@pytest.fixture
def client(server: Server) -> Client:
    return Client(server.url, retries=PATIENT)


def test_a_photo_in_every_form(client: Client) -> None:
    path = RENDERS / "000.jpg"
    with client, path.open("rb") as opened:
        answers = [
            client.poses(photo, max_people=1, candidates=0)
            for photo in (path, str(path), path.read_bytes(), opened, io.BytesIO(path.read_bytes()))
        ]
    people = [json.dumps(answer["people"]) for answer in answers]
    assert len(set(people)) == 1
    assert schemas.PosesAnswer.model_validate(answers[0]).people


def test_parameters_reach_the_service(client: Client, renders: list[Render]) -> None:
    render = renders[0]
    low, high = render.joints_px.min(axis=0), render.joints_px.max(axis=0)
    with client:
        answer = client.poses(
            render.data,
            box_px=(*low, *(high - low)),
            focal_length_px=render.focal_length_px,
            method="paper",
            mirrored=False,
            subject_height_mm=1700,
            candidates=2,
        )
    person = answer["people"][0]
    assert answer["method"] == "paper"
    assert person["camera"] is not None
    assert person["camera"]["focal_source"] == "request"
    assert (person["scale_source"], len(person["candidates"])) == ("request", 2)


def test_several_photos(client: Client, renders: list[Render]) -> None:
    with client:
        batch = client.poses_batch([renders[0].data, b"no photo"], max_people=1)
    first, second = batch["images"]
    assert first["answer"] is not None
    assert second["problem"] is not None
    assert second["problem"]["type"].endswith("unsupported-image-type")


def test_the_other_endpoints(client: Client) -> None:
    request = json.loads((ROOT / "app" / "examples" / "lift_request.json").read_text())
    with client:
        client.wait_until_ready()
        info = client.info()
        lifted = client.lift(request)
        match = lifted["people"][0]["exemplar"]
        assert match is not None
        exemplar = client.exemplar(match["id"])
        with pytest.raises(RefusedError) as caught:
            client.exemplar("no:such:exemplar")
    assert info["library"] == lifted["library"] == exemplar["library"]
    assert len(exemplar["joints_mm"]) == 14
    assert (caught.value.status, caught.value.slug) == (404, "exemplar-not-found")


@pytest.mark.parametrize(
    ("photo", "status", "slug"),
    [
        (b"", 400, "empty-body"),
        (b"GIF89a" + bytes(50), 415, "unsupported-image-type"),
        (bytes(3_000_000), 413, "body-too-large"),
    ],
    ids=["empty", "gif", "large"],
)
def test_refusals(client: Client, photo: bytes, status: int, slug: str) -> None:
    with client, pytest.raises(RefusedError) as caught:
        client.poses(photo)
    assert (caught.value.status, caught.value.slug) == (status, slug)
    assert caught.value.request_id


def test_a_bad_value_is_named(client: Client) -> None:
    with client, pytest.raises(RefusedError, match="max_people"):
        client.poses(b"x", max_people=99)


def test_keys(keyed_server: Server) -> None:
    with Client(keyed_server.url) as client, pytest.raises(RefusedError, match="401"):
        client.info()
    with Client(keyed_server.url, api_key=API_KEY) as client:
        assert client.info()["name"] == "posematch"


def test_nobody_there() -> None:
    url = f"http://127.0.0.1:{free_port()}"
    with Client(url, retries=Retries(deadline_s=0.5)) as client, pytest.raises(UnreachableError):
        client.info()


def test_a_crowd_is_served_in_the_end(narrow_server: Server, renders: list[Render]) -> None:
    """A dozen at once at a service with room for two: each is refused, waits, is answered."""

    async def run() -> list[int]:
        async with AsyncClient(narrow_server.url, retries=PATIENT) as client:
            found: list[int] = []

            async def one() -> None:
                answer = await client.poses(renders[0].data, candidates=0)
                found.append(len(answer["people"]))

            async with anyio.create_task_group() as group:
                for _ in range(12):
                    group.start_soon(one)
            return found

    assert anyio.run(run) == [1] * 12
    lines = narrow_server.client.get("/metrics").text.splitlines()
    refused = [line for line in lines if line.startswith("posematch_refused_total")]
    assert sum(float(line.rsplit(" ", 1)[1]) for line in refused) > 0


def test_asynchronously(server: Server) -> None:
    async def run() -> None:
        async with AsyncClient(server.url, retries=PATIENT) as client:
            await client.wait_until_ready()
            assert (await client.info())["skeleton"]["name"] == "lsp14"
            batch = await client.poses_batch([RENDERS / "000.jpg", RENDERS / "006.jpg"])
            assert all(item["answer"] for item in batch["images"])
            request = json.loads((ROOT / "app" / "examples" / "lift_request.json").read_text())
            lifted = await client.lift(request)
            match = lifted["people"][0]["exemplar"]
            assert match is not None
            assert (await client.exemplar(match["id"]))["id"] == match["id"]

    anyio.run(run)
