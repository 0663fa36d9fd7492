"""Jobs: taken by one worker at a time, taken over from the dead, fulfilled once."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from threading import Barrier

import pytest
import sqlalchemy as sa
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from fleetmap.errors import ConflictError, JobLostError
from fleetmap.jobs import JobEntry
from fleetmap_server.database import Database
from fleetmap_server.drives import Drives
from fleetmap_server.jobs import MAX_ATTEMPTS, Jobs
from fleetmap_server.problems import BadRequestError, NotFoundError

LEASE_NS = 60_000_000_000
SECOND_NS = 1_000_000_000


def sha256(name: str) -> str:
    return hashlib.sha256(name.encode()).hexdigest()


class Clock:
    """Moves when it is told to, and a little each time that it is looked at."""

    def __init__(self) -> None:
        self.now_ns = 1_700_000_000 * SECOND_NS

    def __call__(self) -> int:
        self.now_ns += 1
        return self.now_ns


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    with closing(Database(database_url)) as opened:
        yield opened


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def jobs(database: Database, clock: Clock) -> Jobs:
    return Jobs(database, clock)


@pytest.fixture
def queue(database: Database, jobs: Jobs) -> Callable[..., JobEntry]:
    def queue(drive: str = "monday", map_id: str = "town") -> JobEntry:
        with database.writing() as connection:
            Drives(database).add(connection, sha256(drive), f"{drive}.mcap", 1000)
            return jobs.queue(connection, sha256(drive), map_id)

    return queue


def taken(jobs: Jobs, worker: str = "one") -> JobEntry:
    job = jobs.take(worker)
    assert job is not None
    return job


def fulfil(database: Database, jobs: Jobs, job: JobEntry, version: str = sha256("a map")) -> JobEntry:
    with database.writing() as connection:
        return jobs.fulfil(connection, job.job_id, job.fence, version)


def test_a_job_from_queue_to_map(database, jobs, queue):
    queued = queue()
    assert (queued.state, queued.attempts, queued.fence) == ("queued", 0, 0)
    job = taken(jobs)
    assert (job.job_id, job.state, job.attempts, job.fence) == (queued.job_id, "running", 1, 1)
    assert jobs.take("two") is None
    told = jobs.report(job.job_id, job.fence, "features", 40)
    assert (told.stage, told.percent, told.cancel_requested) == ("features", 40, False)
    done = fulfil(database, jobs, job)
    assert (done.state, done.percent, done.version) == ("done", 100, sha256("a map"))
    assert jobs.get(job.job_id) == done
    assert fulfil(database, jobs, job) == done  # the answer was lost
    with pytest.raises(JobLostError, match="not running any more, it is done"):
        fulfil(database, jobs, job, version=sha256("another map"))


def test_silence_counts_from_the_start_of_a_server_that_was_away(jobs, queue, clock):
    queue()
    job = taken(jobs)
    clock.now_ns += 10 * LEASE_NS
    jobs.forgive_silence()
    assert jobs.take("two") is None
    assert jobs.report(job.job_id, job.fence, "features", 50).state == "running"
    clock.now_ns += 10 * LEASE_NS
    jobs.forgive_silence()
    clock.now_ns += LEASE_NS + SECOND_NS
    assert taken(jobs, "two").fence == job.fence + 1


def test_a_drive_has_one_job_for_a_map(database, jobs, queue):
    first = queue()
    assert queue().job_id == first.job_id
    assert queue(map_id="country").job_id != first.job_id
    fulfil(database, jobs, taken(jobs))
    assert queue().version == sha256("a map")
    with database.writing() as connection, pytest.raises(NotFoundError, match="no drive"):
        jobs.queue(connection, sha256("unheard of"), "town")


def test_the_longest_waiting_comes_first(jobs, queue):
    names = ["c", "a", "b"]
    waiting = [queue(drive=name).job_id for name in names]
    assert [taken(jobs, f"worker-{name}").job_id for name in names] == waiting


def test_a_worker_that_asks_again_holds_one_job(jobs, queue):
    queue("monday")
    queue("tuesday")
    first = taken(jobs)
    again = taken(jobs)
    assert (again.job_id, again.fence, again.attempts) == (first.job_id, first.fence, 1)
    assert taken(jobs, "two").job_id != first.job_id


def test_a_silent_workers_job_goes_to_the_next_and_the_first_is_heard_no_more(database, jobs, queue, clock):
    queue()
    dead = taken(jobs)
    clock.now_ns += LEASE_NS - SECOND_NS
    jobs.report(dead.job_id, dead.fence, "features", 10)
    clock.now_ns += LEASE_NS - SECOND_NS
    assert jobs.take("two") is None
    clock.now_ns += 2 * SECOND_NS
    heir = taken(jobs, "two")
    assert (heir.job_id, heir.fence, heir.attempts, heir.stage) == (dead.job_id, dead.fence + 1, 2, "")
    for speak in (
        lambda: jobs.report(dead.job_id, dead.fence, "features", 11),
        lambda: jobs.finish(dead.job_id, dead.fence, "oh"),
        lambda: fulfil(database, jobs, dead),
    ):
        with pytest.raises(JobLostError, match="taken over by 'two'"):
            speak()
    assert fulfil(database, jobs, heir).state == "done"


def test_a_worker_that_was_only_slow_goes_on_if_nobody_else_came(database, jobs, queue, clock):
    queue()
    job = taken(jobs)
    clock.now_ns += 10 * LEASE_NS
    assert jobs.report(job.job_id, job.fence, "features", 10).lease_until_ns > clock.now_ns
    assert fulfil(database, jobs, job).state == "done"


def test_what_three_workers_died_on_has_failed(jobs, queue, clock):
    queue()
    for number in range(MAX_ATTEMPTS):
        job = taken(jobs, f"worker-{number}")
        jobs.report(job.job_id, job.fence, "optimising", 30 + number)
        clock.now_ns += 2 * LEASE_NS
    seen = jobs.get(job.job_id)
    assert (seen.state, seen.attempts) == ("failed", MAX_ATTEMPTS)
    assert seen.reason == "3 workers fell silent over it, the last ('worker-2') at optimising 32 %"
    assert jobs.take("four") is None
    assert jobs.retry(job.job_id).attempts == 0
    assert taken(jobs, "five").fence == job.fence + 1


def test_a_job_given_back_is_there_at_once_and_counts_no_attempt(jobs, queue):
    queue()
    job = taken(jobs)
    back = jobs.finish(job.job_id, job.fence, "", give_back=True)
    assert (back.state, back.attempts, back.worker) == ("queued", 0, "")
    assert jobs.finish(job.job_id, job.fence, "", give_back=True) == back
    assert taken(jobs, "two").fence == 2


def test_a_job_fails_with_its_workers_reason(jobs, queue):
    queue()
    job = taken(jobs)
    failed = jobs.finish(job.job_id, job.fence, "no GNSS")
    assert (failed.state, failed.reason) == ("failed", "no GNSS")
    assert jobs.finish(job.job_id, job.fence, "no GNSS") == failed
    with pytest.raises(ConflictError, match="it failed"):
        jobs.cancel(job.job_id)


def test_a_waiting_job_is_cancelled_at_once(jobs, queue):
    job = queue()
    assert jobs.cancel(job.job_id).state == "cancelled"
    assert jobs.cancel(job.job_id).state == "cancelled"
    assert jobs.take("one") is None
    assert jobs.retry(job.job_id).state == "queued"
    assert taken(jobs).job_id == job.job_id


def test_a_running_jobs_worker_is_asked_to_stop(database, jobs, queue):
    queue()
    job = taken(jobs)
    assert jobs.cancel(job.job_id).cancel_requested
    told = jobs.report(job.job_id, job.fence, "features", 50)
    assert told.cancel_requested
    assert told.lease_until_ns == job.lease_until_ns  # it does not live on reports
    with pytest.raises(JobLostError, match="being cancelled"):
        fulfil(database, jobs, job)
    ended = jobs.finish(job.job_id, job.fence, "", give_back=True)
    assert (ended.state, ended.reason) == ("cancelled", "cancelled")


def test_a_cancelled_jobs_worker_that_does_not_answer_is_not_waited_for(jobs, queue, clock):
    queue()
    job = taken(jobs)
    jobs.cancel(job.job_id)
    clock.now_ns += LEASE_NS + SECOND_NS
    assert jobs.counts()["cancelled"] == 1
    assert jobs.get(job.job_id).state == "cancelled"
    with pytest.raises(JobLostError, match="it is cancelled"):
        jobs.report(job.job_id, job.fence, "features", 60)


def test_what_is_done_or_done_by_another_job_is_not_tried_again(database, jobs, queue):
    first = queue()
    jobs.cancel(first.job_id)
    second = queue()
    assert second.job_id != first.job_id
    with pytest.raises(ConflictError, match=second.job_id):
        jobs.retry(first.job_id)
    fulfil(database, jobs, taken(jobs))
    with pytest.raises(ConflictError, match="is done"):
        jobs.retry(second.job_id)
    with pytest.raises(ConflictError, match="it is done"):
        jobs.cancel(second.job_id)


def test_the_jobs_of_a_retired_drive_end(database, jobs, queue):
    waiting, other = queue(map_id="town"), queue(map_id="country")
    running = taken(jobs)
    assert running.job_id == waiting.job_id
    with database.writing() as connection:
        Drives(database).retire(connection, sha256("monday"))
        jobs.cancel_all_of(connection, sha256("monday"))
    assert jobs.get(running.job_id).cancel_requested
    assert jobs.get(other.job_id).state == "cancelled"
    with pytest.raises(NotFoundError, match="no drive"):
        jobs.retry(other.job_id)


def test_nobody_knows_a_job_that_is_not_there(jobs):
    for ask in (jobs.get, jobs.cancel, jobs.retry, lambda job_id: jobs.report(job_id, 1, "", 0)):
        with pytest.raises(NotFoundError, match="no job 0123456789abcdef"):
            ask("0123456789abcdef")


def test_jobs_are_listed_page_by_page_newest_first(jobs, queue):
    waiting = [queue(drive=f"drive {number}") for number in range(7)]
    taken(jobs)
    expected = [job.job_id for job in reversed(waiting)]
    found, after = [], None
    while True:
        page = jobs.page(limit=3, after=after)
        found += [job.job_id for job in page.jobs]
        if len(found) == 3:
            queue(drive="one more meanwhile")
        if (after := page.next_after) is None:
            break
    assert found == expected
    assert [job.job_id for job in jobs.page(state="running").jobs] == expected[-1:]
    assert [job.job_id for job in jobs.page(drive=waiting[3].drive).jobs] == [waiting[3].job_id]
    assert jobs.counts() == {"queued": 7, "running": 1, "done": 0, "failed": 0, "cancelled": 0}
    with pytest.raises(BadRequestError):
        jobs.page(after="nonsense")


def test_eight_workers_do_forty_jobs_each_once(database, jobs, database_url):
    with database.writing() as connection:
        for number in range(40):
            Drives(database).add(connection, sha256(f"drive {number}"), "drive.mcap", 1000)
            jobs.queue(connection, sha256(f"drive {number}"), "town")
    start = Barrier(8)

    def work(name: str) -> list[str]:
        done = []
        with closing(Database(database_url)) as own:
            own_jobs = Jobs(own)
            start.wait(30)
            while (job := own_jobs.take(name)) is not None:
                own_jobs.report(job.job_id, job.fence, "features", 50)
                done.append(fulfil(own, own_jobs, job, version=sha256(name)).job_id)
        return done

    with ThreadPoolExecutor(8) as pool:
        done = Counter(job_id for found in pool.map(work, map("worker-{}".format, range(8))) for job_id in found)
    assert len(done) == 40
    assert set(done.values()) == {1}
    assert jobs.counts()["done"] == 40
    assert all(job.attempts == 1 for job in jobs.page().jobs)


DRIVES = ("monday", "tuesday")
WORKERS = ("one", "two", "three")


class Death(BaseException):
    """Of a process, as its database sees it."""


class Model:
    """A job as it should be."""

    def __init__(self, job: JobEntry) -> None:
        self.job_id, self.drive, self.created_ns = job.job_id, job.drive, job.created_ns
        self.state, self.attempts, self.fence, self.worker = "queued", 0, 0, ""
        self.lease_until_ns, self.is_to_stop, self.version = 0, False, None

    def end_if_overdue(self, now_ns: int) -> None:
        if self.state == "running" and self.lease_until_ns < now_ns:
            if self.is_to_stop:
                self.state = "cancelled"
            elif self.attempts == MAX_ATTEMPTS:
                self.state = "failed"

    def is_takeable(self, now_ns: int) -> bool:
        return self.state == "queued" or (self.state == "running" and self.lease_until_ns < now_ns)

    def queue_again(self, attempts: int) -> None:
        self.state, self.attempts, self.worker, self.is_to_stop = "queued", attempts, "", False


class Workers(RuleBasedStateMachine):
    """Several workers and operators on two servers, any of whom may die or come back at any step."""

    database: Database

    def __init__(self) -> None:
        super().__init__()
        self.clock = Clock()
        self.servers = [Jobs(self.database, self.clock, LEASE_NS / 1e9) for _ in range(2)]
        self.models: dict[str, Model] = {}
        self.tokens: list[JobEntry] = []  # every taking there ever was; whoever has one may speak at any time
        self.fulfilled: Counter[str] = Counter()
        with self.database.writing() as connection:
            connection.execute(sa.text("DELETE FROM jobs"))
            for drive in DRIVES:
                Drives(self.database).add(connection, sha256(drive), f"{drive}.mcap", 1000)

    def tidy(self) -> int:
        for model in self.models.values():
            model.end_if_overdue(self.clock.now_ns)
        return self.clock.now_ns

    @initialize()
    def begin_at_work(self):
        self.queue(0, DRIVES[0])
        self.queue(1, DRIVES[1])
        self.take(0, WORKERS[0])

    @rule(server=st.integers(0, 1), drive=st.sampled_from(DRIVES))
    def queue(self, server, drive):
        self.tidy()
        mine = [m for m in self.models.values() if m.drive == sha256(drive)]
        known = [m for m in mine if m.state in ("queued", "running")] or [m for m in mine if m.state == "done"][
            -1:
        ]
        with self.database.writing() as connection:
            job = self.servers[server].queue(connection, sha256(drive), "town")
        if known:
            assert job.job_id == known[0].job_id
        else:
            assert job.job_id not in self.models
            self.models[job.job_id] = Model(job)

    @rule(server=st.integers(0, 1), worker=st.sampled_from(WORKERS))
    def take(self, server, worker):
        now_ns = self.tidy()
        job = self.servers[server].take(worker)
        own = [m for m in self.models.values() if (m.state, m.worker, m.is_to_stop) == ("running", worker, False)]
        takeable = sorted((m.created_ns, m.job_id) for m in self.models.values() if m.is_takeable(now_ns))
        if not own and not takeable:
            assert job is None
            return
        model = own[0] if own else self.models[takeable[0][1]]
        if not own:
            model.attempts, model.fence, model.state = model.attempts + 1, model.fence + 1, "running"
            model.worker, model.is_to_stop = worker, False
        assert job is not None
        assert (job.job_id, job.fence, job.attempts) == (model.job_id, model.fence, model.attempts)
        model.lease_until_ns = job.lease_until_ns
        assert now_ns + LEASE_NS < job.lease_until_ns <= self.clock.now_ns + LEASE_NS
        self.tokens.append(job)

    def speak(self, data):
        """Somebody who was given a job at some time, and whether he still has it."""
        token = self.tokens[data.draw(st.integers(0, len(self.tokens) - 1), "token")]
        model = self.models[token.job_id]
        return token, model, (model.state, model.fence) == ("running", token.fence)

    @rule(server=st.integers(0, 1), data=st.data())
    def report(self, server, data):
        token, model, is_heard = self.speak(data)
        if not is_heard:
            with pytest.raises(JobLostError):
                self.servers[server].report(token.job_id, token.fence, "features", 1)
            return
        told = self.servers[server].report(token.job_id, token.fence, "features", 1)
        assert told.cancel_requested == model.is_to_stop
        assert told.lease_until_ns == (model.lease_until_ns if model.is_to_stop else self.clock.now_ns + LEASE_NS)
        model.lease_until_ns = told.lease_until_ns

    @rule(server=st.integers(0, 1), give_back=st.booleans(), data=st.data())
    def finish(self, server, give_back, data):
        token, model, is_heard = self.speak(data)
        is_repeated = model.fence == token.fence and model.state in ("queued", "failed", "cancelled")
        if not is_heard and not is_repeated:
            with pytest.raises(JobLostError):
                self.servers[server].finish(token.job_id, token.fence, "unfit", give_back)
            return
        self.servers[server].finish(token.job_id, token.fence, "unfit", give_back)
        if is_heard and model.is_to_stop:
            model.state = "cancelled"
        elif is_heard and give_back:
            model.queue_again(model.attempts - 1)
        elif is_heard:
            model.state = "failed"

    @rule(server=st.integers(0, 1), dies=st.booleans(), version=st.sampled_from("xy"), data=st.data())
    def publish(self, server, dies, version, data):
        """A server that dies before its transaction ends has published nothing."""
        token, model, is_heard = self.speak(data)
        is_repeated = (model.state, model.fence, model.version) == ("done", token.fence, sha256(version))
        try:
            with self.database.writing() as connection:
                self.servers[server].fulfil(connection, token.job_id, token.fence, sha256(version))
                if dies:
                    raise Death
        except Death:
            assert is_repeated or (is_heard and not model.is_to_stop)
        except JobLostError:
            assert not is_repeated
            assert not is_heard or model.is_to_stop
        else:
            assert is_repeated or (is_heard and not model.is_to_stop)
            self.fulfilled[token.job_id] += not is_repeated
            model.state, model.version = "done", sha256(version)

    @rule(server=st.integers(0, 1), data=st.data())
    def cancel(self, server, data):
        model = data.draw(st.sampled_from(list(self.models.values())), "job")
        if model.state in ("done", "failed"):
            with pytest.raises(ConflictError):
                self.servers[server].cancel(model.job_id)
            return
        self.servers[server].cancel(model.job_id)
        if model.state == "running" and model.lease_until_ns >= self.clock.now_ns:
            model.is_to_stop = True
        else:
            model.state = "cancelled"

    @rule(server=st.integers(0, 1), data=st.data())
    def retry(self, server, data):
        self.tidy()
        model = data.draw(st.sampled_from(list(self.models.values())), "job")
        others = [m for m in self.models.values() if m.drive == model.drive and m.state in ("queued", "running")]
        if model.state == "done" or (others and model not in others):
            with pytest.raises(ConflictError):
                self.servers[server].retry(model.job_id)
            return
        self.servers[server].retry(model.job_id)
        if model.state in ("failed", "cancelled"):
            model.queue_again(0)

    @rule(seconds=st.sampled_from([1, 59, 61, 200]))
    def time_passes(self, seconds):
        self.clock.now_ns += seconds * SECOND_NS

    @invariant()
    def the_catalogue_agrees(self):
        found = {job.job_id: job for job in self.servers[0].page().jobs}
        self.tidy()
        assert found.keys() == self.models.keys()
        for job_id, model in self.models.items():
            job = found[job_id]
            seen = (job.state, job.attempts, job.fence, job.worker, job.version)
            assert seen == (model.state, model.attempts, model.fence, model.worker, model.version)
        assert all(count == 1 for count in self.fulfilled.values())
        assert set(self.fulfilled) == {m.job_id for m in self.models.values() if m.state == "done"}

    def teardown(self):
        """Whatever happened, workers that come and live bring every job to its end."""
        for number in range(2 * len(self.models) + 1):
            self.clock.now_ns += 2 * LEASE_NS
            job = self.servers[0].take(f"late-{number}")
            if job is None:
                break
            fulfil(self.database, self.servers[1], job)
        assert all(job.is_over for job in self.servers[0].page().jobs)
        super().teardown()


def test_whatever_workers_do_and_whenever_they_die_no_job_is_fulfilled_twice_or_lost(database):
    class OnThisDatabase(Workers):
        pass

    OnThisDatabase.database = database
    run_state_machine_as_test(
        OnThisDatabase,
        settings=settings(
            max_examples=30 if database.dialect == "sqlite" else 10,
            stateful_step_count=40,
            deadline=None,
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
        ),
    )
