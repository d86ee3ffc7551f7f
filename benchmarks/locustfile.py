"""Users who send photos, for locust (kept in an environment of its own, it is no dependency).

python3 -m venv locust && locust/bin/pip install locust
locust/bin/locust -f benchmarks/locustfile.py --headless -u 8 -r 8 -t 30s -H http://127.0.0.1:8000
"""

from __future__ import annotations

from pathlib import Path

from locust import HttpUser, constant, task

PHOTOS = [
    path.read_bytes()
    for path in sorted((Path(__file__).parent.parent / "tests/data/renders").glob("*.jpg"))
]


class Photographer(HttpUser):
    """Sends photo after photo; a refusal counts as an answer of its own name, not as a failure."""

    wait_time = constant(0)
    sent = 0

    @task
    def post_photo(self) -> None:
        """Send the next photo."""
        photo = PHOTOS[self.sent % len(PHOTOS)]
        self.sent += 1
        with self.client.post("/v1/poses", data=photo, catch_response=True) as response:
            if response.status_code == 503:
                response.request_meta["name"] = "refused"
                response.success()
