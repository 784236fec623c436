"""The JavaScript client, run by Node: against a running service, and against one whose connections break."""

from __future__ import annotations

import base64
import json
import re

import pytest
from api_server import ROOT, create_app, fake_estimators, key_of, photo, serving, settings, until
from fake_service import FakeService
from node import node
from stand_ins import make_scene
from test_scenes import TRANSFORMS, archive, ply
from two_fronts import FRONTS

from service.live.live_values import LiveFrame
from service.types import Intrinsics
from service.web.key_file import add_key
from service.web.schemas.frame_message import read_frame

CLIENT = ROOT / "service" / "web" / "static" / "client.js"
IMPORT = f'import {{ Client, ServiceError }} from "{CLIENT.as_uri()}";\n'


def test_it_is_served_and_needs_nothing(shared):
    answer = shared.get("/client.js")
    assert answer.headers["content-type"].startswith("text/javascript")
    assert answer.text == CLIENT.read_text("utf-8")
    assert not re.search(r"^\s*import |\bimport\(", answer.text, re.M)


def test_a_photo_is_localized_in_node(shared):
    module = (
        IMPORT
        + """
const service = new Client(process.argv[2], { key: process.argv[4] });
const file = new File([Buffer.from(process.argv[3], "base64")], "a.jpg");
const steps = [], codes = [];
const truth = { position: [0, 0, 0], quaternion_wxyz: [1, 0, 0, 0] };
const job = await service.localize(file, { scene: "room", seed: 5, truth },
  { onRecord: step => steps.push(step.index) });
const code = error => codes.push([error instanceof ServiceError, error.code, error.status]);
await service.localize(file, { scene: "nowhere" }).catch(code);
await service.follow("nothing").catch(code);
await service.submit(new Blob(["x"]), { scene: "room" }).catch(code);
const stored = await service.job(job.id), { jobs } = await service.jobs({ limit: 1 });
const picture = await service.render("room", { position: [0, 0, 0], quaternion_wxyz: [1, 0, 0, 0] });
console.log(JSON.stringify({ steps, codes, seed: stored.seed, name: stored.photo.name, newest: jobs.length,
  rows: job.result.pose.world_from_camera.matrix.length, scenes: (await service.scenes()).map(scene => scene.id),
  picture: picture.size > 100 }));
"""
    )
    told = json.loads(node(module, str(shared.base_url), base64.b64encode(photo()).decode(), key_of(shared)))
    assert told["steps"] == list(range(len(told["steps"])))
    assert told["steps"]
    assert told["codes"] == [
        [True, "scene_not_found", 404],
        [True, "job_not_found", 404],
        [True, "invalid_image", 422],
    ]
    assert (told["seed"], told["name"], told["rows"], told["picture"]) == (5, "a.jpg", 4, True)
    assert told["scenes"] == ["room"]


@pytest.mark.ci
def test_scenes_links_and_keys_are_managed_in_node(tmp_path):
    (tmp_path / "attic").mkdir()
    (tmp_path / "attic" / "scene.ply").write_bytes(ply())
    boss = add_key(tmp_path / "keys.json", "boss", "admin")
    changes = {"keys_file": tmp_path / "keys.json", "scenes": [tmp_path / "attic"], "cache_dir": None}
    module = (
        IMPORT
        + """
const service = new Client(process.argv[2], { key: process.argv[3] });
const file = new File([Buffer.from(process.argv[4], "base64")], "a.jpg");
const point = await service.putAnchor("attic", "the door", [1, 2, 3.5]), anchors = await service.anchors("attic");
await service.deleteAnchor("attic", "the door");
const made = await service.addKey("robot 7", { scenes: ["room"], queue_share: 0.5 });
const robot = new Client(process.argv[2], { key: made.key }), own = await robot.ownKey();
const { id } = await robot.submit(file, { scene: "room" }), link = await robot.share(id, { expiresInS: 60 });
const refused = await robot.coverage("attic").catch(error => [error.code, error.status]);
const job = (await (await fetch(`${link.url}/job`)).json()).job.id === id;
const names = (await service.keys()).map(k => k.name);
await service.removeKey("robot 7");
const gone = await robot.ownKey().catch(error => error.code);
console.log(JSON.stringify({ point, anchors, left: (await service.anchors("attic")).length, own, job, names,
  refused, gone, coverage: (await service.coverage("attic")).state, valid: link.expires_in_s }));
"""
    )
    with fake_estimators(), serving(create_app(settings(**changes), {"room": make_scene()})) as http:
        until(lambda: http.get("/scenes/room", headers={"Authorization": f"Bearer {boss}"}).json()["state"] == "ready")
        told = json.loads(node(module, str(http.base_url), boss, base64.b64encode(photo()).decode()))
    assert told["point"] == {"name": "the door", "position": [1, 2, 3.5]}
    assert (told["anchors"], told["left"]) == ([told["point"]], 0)
    own = {"name": "robot 7", "role": "localize", "scenes": ["room"], "rate": None, "queue_share": 0.5, "expires": None}
    assert told["own"] == own
    assert (told["job"], told["valid"], told["names"]) == (True, 60, ["boss", "robot 7"])
    assert (told["refused"], told["gone"], told["coverage"]) == (["scene_not_found", 404], "unauthorized", "none")


@pytest.mark.ci
def test_scenes_are_uploaded_loaded_and_deleted_in_node(tmp_path):
    key = add_key(tmp_path / "keys.json", "boss", "admin")
    module = (
        IMPORT
        + """
const service = new Client(process.argv[2], { key: process.argv[3] }), shares = [], codes = [];
const bytes = Buffer.from(process.argv[4], "base64"), onProgress = share => shares.push(share);
const code = error => codes.push(error.code);
const state = async () => (await service.scenes()).find(scene => scene.id === "cellar").state;
const atEachFront = async ask => { for (let k = 0; k < +process.argv[6]; k++) await ask(); };
const added = await service.uploadScene("cellar", new Blob([bytes]), { name: "cellar.zip", onProgress });
const ready = await service.waitUntilReady("cellar"), { training_cameras } = await service.scene("cellar");
await service.uploadScene("cellar", new Blob([bytes])).catch(code);
await service.uploadScene("junk", new File(["no scene"], "junk.txt")).catch(code);
await atEachFront(() => service.unloadScene("cellar"));
await atEachFront(async () => {
  while (await state() !== "unloaded") await new Promise(resolve => setTimeout(resolve, 20));
});
await service.waitUntilReady("cellar").catch(code);
await atEachFront(() => service.loadScene("cellar"));
const again = (await service.waitUntilReady("cellar")).state;
await service.deleteScene("cellar");
await service.scene("cellar").catch(code);
await service.deleteScene("room").catch(code);
const photo = new File([Buffer.from(process.argv[5], "base64")], "a.jpg"), stop = new AbortController();
const { id } = await service.localize(photo, { scene: "room" }, { onProgress });
await service.deleteJob(id);
await service.job(id).catch(code);
stop.abort();
await service.uploadScene("late", new Blob([bytes]), { signal: stop.signal }).catch(error => codes.push(error.name));
console.log(JSON.stringify({ added, ready, again, training_cameras, shares, codes }));
"""
    )
    changes = {"keys_file": tmp_path / "keys.json", "data_dir": tmp_path / "data", "cache_dir": None}
    with fake_estimators() as stepping, serving(create_app(settings(**changes), {"room": make_scene()})) as http:
        stepping.GO_ON.set()
        until(lambda: http.get("/scenes/room", headers={"Authorization": f"Bearer {key}"}).json()["state"] == "ready")
        folder = archive(cellar__scene_dot_ply=ply(), cellar__transforms_dot_json=json.dumps(TRANSFORMS))
        sent = [base64.b64encode(data).decode() for data in (folder, photo())]
        told = json.loads(node(module, str(http.base_url), key, *sent, str(FRONTS)))
    assert (told["added"]["uploaded"], told["ready"]["state"], told["again"]) == (True, "ready", "ready")
    assert told["ready"]["gaussians"] > 0
    assert len(told["training_cameras"]) == len(TRANSFORMS["frames"])
    assert told["shares"] == [1, 1]  # a file and a photo: Node doesn't tell more
    refused = ["scene_exists", "invalid_request", "scene_unloaded", "scene_not_found", "scene_in_use"]
    assert told["codes"] == [*refused, "job_not_found", "AbortError"]


def test_a_lost_connection_is_taken_up_where_it_broke():
    job = FakeService().job("b", 4, finished=True)
    events = [chunk.decode() for chunk in job.events() if not chunk.startswith(b":")]
    module = (
        IMPORT
        + """
import http from "node:http";
const events = JSON.parse(process.argv[2]), asked = [], told = [];
const server = http.createServer((request, response) => {
  asked.push([request.headers["last-event-id"] ?? "", request.headers.authorization ?? ""]);
  if (asked.length === 2) return response.writeHead(502).end("starting");
  response.writeHead(200, { "Content-Type": "text/event-stream" });
  const from = events.findIndex(text => text.includes(`id: ${asked.at(-1)[0]}\\n`)) + 1;
  if (asked.length > 1) return response.end(events.slice(from).join(""));
  // Half of an event, then the connection breaks.
  response.write(events[0] + ": ping\\n\\n" + events[1] + events[2].slice(0, 40));
  setTimeout(() => response.destroy(), 50);
}).listen(0, "127.0.0.1", async () => {
  const service = new Client(`http://127.0.0.1:${server.address().port}/splatfix`, { key: " a-key\\n" });
  const ended = await service.follow("b", { onRecord: step => told.push(step.index),
    onLost: () => told.push("lost"), onResumed: () => told.push("resumed") });
  console.log(JSON.stringify({ asked, told, score: ended.result.score, base: service.base.pathname }));
  server.close();
});
"""
    )
    told = json.loads(node(module, json.dumps(events)))
    assert told["told"] == [0, 1, "lost", "resumed", 2, 3]
    assert told["asked"] == [["", "Bearer a-key"], ["1.1", "Bearer a-key"], ["1.1", "Bearer a-key"]]
    assert (told["score"], told["base"]) == (0.93, "/splatfix/")


def test_its_live_messages_are_read_as_frames():
    module = f"""
import {{ liveMessage }} from "{CLIENT.as_uri()}";
const jpeg = Uint8Array.from(Buffer.from(process.argv[2], "base64")).buffer;
const odom = [[0, -1, 0, 4], [1, 0, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]], lens = [500.5, 501, 320, 240];
const third = liveMessage(9, 3, jpeg, undefined, odom, [0, -1, 0]);
const texts = [liveMessage(7, 1.25, jpeg), liveMessage(8, 2.5, jpeg, lens), third];
console.log(JSON.stringify(texts.map(message => Buffer.from(message).toString("base64"))));
"""
    messages = [base64.b64decode(text) for text in json.loads(node(module, base64.b64encode(photo()).decode()))]
    first = read_frame(messages[0], None)
    assert first == LiveFrame(7, 1.25, photo())
    assert read_frame(messages[1], first).intrinsics == Intrinsics(96, 64, 500.5, 501.0, 320.0, 240.0)
    third = read_frame(messages[2], first)
    assert (third.intrinsics, third.up_in_camera, third.data) == (None, (0.0, -1.0, 0.0), photo())
    assert third.odom_from_camera is not None
    assert third.odom_from_camera.world_from_camera[:3].tolist() == [[0, -1, 0, 4], [1, 0, 0, 5], [0, 0, 1, 6]]
