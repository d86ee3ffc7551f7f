"""Users' labelled images: what is read, and what is refused with a reason."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from library_store.skeleton import LSP14
from models.errors import AnnotationError
from models.training.users_coco import KEPT_PX, read_coco
from models.training.users_h36m import read_human36m
from tests.app.imaging.image_files import tiff, with_exif
from tests.models.training import user_files

JOINT = {name: i for i, name in enumerate(LSP14.joint_names)}
Records = dict[str, Any]


def test_coco_people_become_crops_in_our_joint_order(tmp_path: Path) -> None:
    records = user_files.coco(tmp_path / "images")
    path = user_files.write(tmp_path / "labels.json", records)
    crops = read_coco(path, tmp_path / "images")
    assert len(crops) == 6
    assert [crop.group for crop in crops] == [0, 0, 1, 1, 2, 2]
    first, second = crops[:2]
    assert first.weight[JOINT["head_top"]] == first.weight[JOINT["neck"]] == 0
    assert first.weight[2:].all()
    assert second.weight.sum() == 8, "legs are not labelled"
    # The person's own left shoulder is on the picture's right.
    assert first.joints_px[JOINT["l_shoulder"], 0] > first.joints_px[JOINT["r_shoulder"], 0]
    # Places in the crop are those in the photo: a patch around the elbow is the same there.
    photo = cv2.imread(str(tmp_path / "images" / "0.png"))
    assert photo is not None
    points = np.array(records["annotations"][0]["keypoints"]).reshape(-1, 3)
    x, y = points[user_files.NAMES.index("left_hip"), :2].round().astype(int)
    u, v = first.joints_px[JOINT["l_hip"]].round().astype(int)
    patch, other = photo[y - 6 : y + 7, x - 6 : x + 7], first.image[v - 6 : v + 7, u - 6 : u + 7]
    assert np.corrcoef(patch.ravel(), other.ravel())[0, 1] > 0.9
    assert max(crop.image.shape[0] for crop in crops) <= KEPT_PX


def test_names_are_understood_in_other_spellings(tmp_path: Path) -> None:
    records = user_files.coco(tmp_path / "images", 1)
    names = [n.replace("left_", "L ").replace("right_", "R-") for n in user_files.NAMES]
    records["categories"][0]["keypoints"] = [*names[1:], "Head-Top"]
    for record in records["annotations"]:
        record["keypoints"] = [*record["keypoints"][3:], *record["keypoints"][:3]]
    crops = read_coco(user_files.write(tmp_path / "l.json", records), tmp_path / "images")
    assert crops[0].weight[JOINT["head_top"]] == 1


def test_what_does_not_matter_is_passed_over(tmp_path: Path) -> None:
    records = user_files.coco(tmp_path / "images")
    path = user_files.write(tmp_path / "labels.json", records)
    wanted = read_coco(path, tmp_path / "images")
    records["images"][0].pop("height", None)
    records["images"].append({"id": 99, "file_name": "not-there.jpg"})
    records["categories"].append({"id": 7, "name": "dog", "keypoints": ["nose", "tail"]})
    person = records["annotations"][0]
    records["annotations"] += [
        {"id": 90, "image_id": 0, "category_id": 7, "keypoints": [5, 5, 2, 6, 6, 2]},
        {"id": 91, "image_id": 0, "category_id": person["category_id"], "bbox": [0, 0, 0, 0]},
        person | {"id": 92, "iscrowd": 1, "segmentation": {"counts": [1, 2], "size": [1, 2]}},
    ]
    user_files.write(path, records)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    found = read_coco(path, tmp_path / "images")
    assert [crop.name for crop in found] == [crop.name for crop in wanted]


@pytest.mark.parametrize("nothing", [None, float("nan")])
def test_what_tools_write_for_not_labelled(tmp_path: Path, nothing: float | None) -> None:
    records = user_files.coco(tmp_path / "images")
    path = user_files.write(tmp_path / "labels.json", records)
    wanted = read_coco(path, tmp_path / "images")
    for record in records["annotations"]:
        flat = record["keypoints"]
        unlabelled = [i for i in range(0, len(flat), 3) if flat[i + 2] == 0]
        for i in unlabelled:
            flat[i : i + 3] = [nothing, nothing, nothing if i % 2 else 0]
        record["iscrowd"] = None
    records["annotations"] += [
        {"id": 90, "image_id": 0, "category_id": 1, "keypoints": None},
        {"id": 91, "image_id": 0, "category_id": 1, "keypoints": [nothing] * 39},
    ]
    records["categories"].append({"id": 9, "name": "ball", "keypoints": None})
    found = read_coco(user_files.write(path, records), tmp_path / "images")
    assert [crop.name for crop in found] == [crop.name for crop in wanted]
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(ours.joints_px, theirs.joints_px)
        np.testing.assert_array_equal(ours.weight, theirs.weight)


def test_phone_photos_labelled_upright_are_read_upright(tmp_path: Path) -> None:
    records = user_files.coco(tmp_path / "images", 1)
    path = user_files.write(tmp_path / "labels.json", records)
    wanted = read_coco(path, tmp_path / "images")
    image = cv2.imread(str(tmp_path / "images" / "0.png"))
    assert image is not None
    lying = cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE)
    _, jpeg = cv2.imencode(".jpg", lying, [cv2.IMWRITE_JPEG_QUALITY, 100])
    (tmp_path / "images" / "0.jpg").write_bytes(with_exif(jpeg.tobytes(), tiff(6)))
    records["images"][0]["file_name"] = "0.jpg"
    found = read_coco(user_files.write(path, records), tmp_path / "images")
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(ours.joints_px, theirs.joints_px)
        assert np.abs(ours.image.astype(int) - theirs.image).mean() < 14, "as JPEG has it"
    # A tool that shows photos as they are stored states their size so.
    records["images"][0] |= {"width": 240, "height": 320}
    for record in records["annotations"]:
        triples = np.array(record["keypoints"]).reshape(-1, 3)
        x, y, v = triples.T
        record["keypoints"] = np.stack([y, np.where(v > 0, 319 - x, 0), v], 1).ravel().tolist()
    found = read_coco(user_files.write(path, records), tmp_path / "images")
    for ours, theirs in zip(found, wanted, strict=True):
        turned = cv2.rotate(theirs.image, cv2.ROTATE_90_COUNTERCLOCKWISE)
        assert np.abs(ours.image.astype(int) - turned).mean() < 14


@pytest.mark.parametrize(
    ("orientation", "size"),
    [(3, {"width": 320, "height": 240}), (6, {}), (6, {"width": 0, "height": 0})],
    ids=["half a turn", "no size", "size unknown"],
)
def test_a_turned_photo_that_may_be_labelled_either_way_is_refused(
    tmp_path: Path, orientation: int, size: dict[str, int]
) -> None:
    """Else people who were labelled upright would be learned upside down."""
    records = user_files.coco(tmp_path / "images", 1)
    image = cv2.imread(str(tmp_path / "images" / "0.png"))
    assert image is not None
    _, jpeg = cv2.imencode(".jpg", image)
    photo = tmp_path / "images" / "0.jpg"
    records["images"] = [{"id": 0, "file_name": "0.jpg"} | size]
    path = user_files.write(tmp_path / "labels.json", records)
    photo.write_bytes(with_exif(jpeg.tobytes(), tiff(orientation)))
    with pytest.raises(
        AnnotationError, match=r"0\.jpg is to be turned .* its size fits either way"
    ):
        read_coco(path, tmp_path / "images")
    photo.write_bytes(with_exif(jpeg.tobytes(), tiff(1)))
    assert len(read_coco(path, tmp_path / "images")) == 2


@pytest.mark.parametrize("name", ["1.png", "again/1.png"])
def test_a_photo_under_two_ids_is_one_image(tmp_path: Path, name: str) -> None:
    """As in merged sets: else one may be held out and the other trained on."""
    records = user_files.coco(tmp_path / "images", 2)
    (tmp_path / "images" / "again").mkdir()
    shutil.copy(tmp_path / "images" / "1.png", tmp_path / "images" / "again" / "1.png")
    records["images"].append(dict(records["images"][1], id=50, file_name=name))
    records["annotations"].append(records["annotations"][0] | {"id": 99, "image_id": 50})
    path = user_files.write(tmp_path / "labels.json", records)
    assert [crop.group for crop in read_coco(path, tmp_path / "images")] == [0, 0, 1, 1, 1]


def _set(index: int, value: float) -> Callable[[Records], None]:
    def change(records: Records) -> None:
        records["annotations"][0]["keypoints"][index] = value

    return change


def _normalised(records: Records) -> None:
    for record in records["annotations"]:
        record["keypoints"] = [
            v if i % 3 == 2 else v / 400 for i, v in enumerate(record["keypoints"])
        ]


DAMAGE: dict[str, tuple[Callable[[Records], object], str]] = {
    "no categories": (lambda r: r.pop("categories"), "categories: Field required"),
    "boxes only": (
        lambda r: [record.pop("keypoints") for record in (*r["categories"], *r["annotations"])],
        "no category has keypoints",
    ),
    "other names": (
        lambda r: r["categories"][0].update(keypoints=[f"k{i}" for i in range(13)]),
        "lacks the keypoints l_ankle",
    ),
    "a name twice": (
        lambda r: r["categories"][0].update(keypoints=["l_hip", *user_files.NAMES]),
        "two keypoints for l_hip",
    ),
    "numbers missing": (
        lambda r: r["annotations"][0]["keypoints"].pop(),
        "annotation 0 has 38 numbers",
    ),
    "text": (lambda r: r["annotations"][0].update(keypoints=["a"]), r"annotations\.0\.keypoints"),
    "keypoints without names": (
        lambda r: [r["annotations"][0]["keypoints"].extend([1, 1, 2]) for _ in range(4)],
        "annotation 0 has 51 numbers.*category's 13 keypoints",
    ),
    "names forgotten": (
        lambda r: r["categories"][0].update(keypoints=[]),
        r"no category says in categories\[\*\]\.keypoints",
    ),
    "visible nowhere": (_set(3, float("nan")), "annotation 0.* its x or y is no number"),
    "infinite": (_set(3, float("inf")), "annotation 0.* its x or y is no number"),
    "confidences": (_set(5, 0.7), "visibility that is not 0, 1 or 2"),
    "outside": (_set(3, 5000.0), r"annotation 0 has a keypoint at \(5000,.*320x240"),
    "normalised": (_normalised, "lie within 0..1"),
    "image gone": (lambda r: r["images"][0].update(file_name="x.png"), "does not exist"),
    "an image twice": (
        lambda r: r["images"].append(dict(r["images"][0], file_name="1.png")),
        "image 0 is 0.png and again 1.png",
    ),
    "resized in width": (
        lambda r: (r["images"][0].update(width=640), r["images"][0].pop("height", None)),
        "an image of 640x240: it was resized",
    ),
    "resized": (lambda r: r["images"][0].update(width=640, height=480), "resized or turned"),
    "unknown image": (lambda r: r["images"].pop(0), "image 0, which is not among images"),
    "nobody": (lambda r: r["annotations"].clear(), "nothing to learn"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_doubtful_coco_files_are_refused(tmp_path: Path, damage: str) -> None:
    change, said = DAMAGE[damage]
    records = user_files.coco(tmp_path / "images")
    change(records)
    path = user_files.write(tmp_path / "labels.json", records)
    with pytest.raises(AnnotationError, match=said) as refusal:
        read_coco(path, tmp_path / "images")
    assert "labels.json" in str(refusal.value)


def test_a_file_that_is_no_json_or_not_there(tmp_path: Path) -> None:
    (tmp_path / "labels.json").write_text("{")
    with pytest.raises(AnnotationError, match="no COCO keypoints file"):
        read_coco(tmp_path / "labels.json", tmp_path)
    with pytest.raises(AnnotationError, match="no such file"):
        read_coco(tmp_path / "none.json", tmp_path)


@pytest.mark.parametrize("data", [b"oops", b""])
def test_a_picture_that_cannot_be_decoded(tmp_path: Path, data: bytes) -> None:
    records = user_files.coco(tmp_path / "images")
    (tmp_path / "images" / "1.png").write_bytes(data)
    with pytest.raises(AnnotationError, match=r"1\.png is no image"):
        read_coco(user_files.write(tmp_path / "labels.json", records), tmp_path / "images")


N_FRAMES, APART = 30, 10


@pytest.fixture
def human36m(tmp_path: Path) -> Path:
    """One clip of a person who walks to the right, as the authors lay it out."""
    from cdflib import cdfwrite

    root = tmp_path / "h36m"
    pose = user_files.human36m_clip(root, "Walking 1.54138969", N_FRAMES)
    poses = root / "S1" / "MyPoseFeatures" / "D2_Positions"
    out = cdfwrite.CDF(str(poses / "Walking 1.54138969.cdf"), cdf_spec={"Compressed": 0})
    out.write_var(
        {
            "Variable": "Pose",
            "Data_Type": 45,
            "Num_Elements": 1,
            "Rec_Vary": True,
            "Var_Type": "zVariable",
            "Dim_Sizes": [N_FRAMES, 64],
        },
        var_data=pose.reshape(1, N_FRAMES, 64),
    )
    out.close()
    np.savez(tmp_path / "pose.npz", Pose=pose.reshape(N_FRAMES, 64))
    return root


def test_frames_of_human36m_lie_under_their_poses(human36m: Path) -> None:
    crops = read_human36m(human36m, frames_apart=APART)
    assert len(crops) == N_FRAMES // APART
    for crop in crops:
        u, v = crop.joints_px[JOINT["l_hip"]].round().astype(int)
        assert crop.image[v - 2 : v + 3, u - 2 : u + 3].mean() > 60, "the figure is there"
        assert crop.joints_px[JOINT["l_hip"], 0] > crop.joints_px[JOINT["r_hip"], 0]


def test_the_cameras_of_a_take_are_one_group(human36m: Path, tmp_path: Path) -> None:
    """They film the same poses at once: none may be held out while another is trained on."""
    folder, videos = (human36m / "S1" / part for part in ("MyPoseFeatures/D2_Positions", "Videos"))
    for name in ("Walking 1.60457274", "Walking.54138969"):
        shutil.copy(tmp_path / "pose.npz", folder / f"{name}.npz")
        shutil.copy(videos / "Walking 1.54138969.mp4", videos / f"{name}.mp4")
    shutil.copytree(human36m / "S1", human36m / "S5")
    groups: dict[str, set[int]] = {}
    for crop in read_human36m(human36m, frames_apart=APART):
        groups.setdefault(crop.name.partition("/")[0], set()).add(crop.group)
    assert groups["Walking 1.54138969"] == groups["Walking 1.60457274"]
    assert len(groups["Walking 1.54138969"]) == 2, "two subjects"
    assert len(set.union(*groups.values())) == 4


def test_npz_may_stand_for_cdf(human36m: Path, tmp_path: Path) -> None:
    folder = human36m / "S1" / "MyPoseFeatures" / "D2_Positions"
    cdf = read_human36m(human36m, frames_apart=APART)
    (folder / "Walking 1.54138969.cdf").unlink()
    (tmp_path / "pose.npz").rename(folder / "Walking 1.54138969.npz")
    npz = read_human36m(human36m, frames_apart=APART)
    for a, b in zip(cdf, npz, strict=True):
        np.testing.assert_array_equal(a.joints_px, b.joints_px)


def test_human36m_that_is_not_whole_is_refused(human36m: Path) -> None:
    for subjects in (("S9",), ("S1", "S9")):
        with pytest.raises(AnnotationError, match="in a folder S9"):
            read_human36m(human36m, subjects)
    folder = human36m / "S1" / "MyPoseFeatures" / "D2_Positions"
    video = human36m / "S1" / "Videos" / "Walking 1.54138969.mp4"
    video.with_name("Sitting.mp4").write_bytes(video.read_bytes())
    # 3D; 17 joints, which have the numbers of 17 frames of 32; one number.
    for others in ((5, 96), (32, 17, 2), ()):
        np.savez(folder / "Sitting.npz", Pose=np.zeros(others))
        with pytest.raises(AnnotationError, match=r"wanted is \(F, 64\)"):
            read_human36m(human36m)
    whole = (folder / "Sitting.npz").read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"PK\x03\x04"):
        (folder / "Sitting.npz").write_bytes(damaged)
        with pytest.raises(AnnotationError, match=r"Sitting\.npz: no array Pose can be read"):
            read_human36m(human36m)
    np.savez(folder / "Sitting.npz", Pose=np.zeros((500, 64)) + 50)
    with pytest.raises(AnnotationError, match="can be read up to frame 30"):
        read_human36m(human36m)
    video.with_name("Sitting.mp4").unlink()
    with pytest.raises(AnnotationError, match=r"Sitting\.mp4 is missing"):
        read_human36m(human36m)
