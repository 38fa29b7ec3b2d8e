"""Cutting an archive into chunks: every frame in one, in order, none twice, and not all at once."""

import numpy as np
import pytest

from _archive import FRAMES, SETTINGS, item
from rasnik.archive.done import DoneFrames, DoneSpan, pack_spans, unpack_spans
from rasnik.archive.plan import Limits, Planner, Span
from rasnik.archive.sources import find_items
from rasnik.archive.systems_table import MissingSystemError


def chunks(items, done=None, **limits):
    planner = Planner(lambda name: SETTINGS, done or DoneFrames(), Limits(**limits))
    return list(planner.chunks(items))


def names(chunk):
    return [span.item.url for span in chunk.spans]


def done_by(spans):
    done = DoneFrames()
    done.add(spans)
    return done


# ------------------------------------------------------------------------ chunks


def test_images_are_cut_by_number_in_order():
    found = chunks((item(f"{k}.png") for k in range(7)), frames=3)
    assert [names(chunk) for chunk in found] == [
        ["0.png", "1.png", "2.png"],
        ["3.png", "4.png", "5.png"],
        ["6.png"],
    ]


def test_images_are_cut_by_size():
    found = chunks([item(f"{k}.png", size=400) for k in range(5)], size=1000)
    assert [len(chunk.spans) for chunk in found] == [2, 2, 1]


def test_chunks_are_of_one_instrument_each_also_where_they_take_turns():
    items = [item(f"{day}/{name}.png", name) for day in range(4) for name in "ab"]
    found = chunks(items, frames=2)
    assert [(chunk.instrument, names(chunk)) for chunk in found] == [
        ("a", ["0/a.png", "1/a.png"]),
        ("b", ["0/b.png", "1/b.png"]),
        ("a", ["2/a.png", "3/a.png"]),
        ("b", ["2/b.png", "3/b.png"]),
    ]


def test_few_images_wait_for_others_of_their_instrument():
    items = (item(f"{k}.png", instrument=str(k)) for k in range(1000))
    planner = Planner(lambda name: SETTINGS, DoneFrames(), Limits(waiting=10))
    first = next(planner.chunks(items))
    assert first.instrument == "0"
    assert next(items).url == "11.png"  # no more were asked for


def test_small_stacks_count_as_many_frames():
    height, width = SETTINGS.system.shape
    found = chunks([item(f"{k}.tif", size=10 * height * width) for k in range(4)], frames=20)
    assert [len(chunk.spans) for chunk in found] == [2, 2]


def test_large_stacks_are_cut_by_frames(tmp_path):
    (tmp_path / "a").mkdir()
    np.save(tmp_path / "a" / "stack.npy", np.concatenate([FRAMES, FRAMES]))
    found = chunks(find_items([str(tmp_path)]), frames=10, counted=1000)
    spans = [span for chunk in found for span in chunk.spans]
    assert [(s.start, s.stop, s.expected) for s in spans] == [
        (0, 10, 10),
        (10, 20, 10),
        (20, None, 4),
    ]
    assert sum(span.size for span in spans) == pytest.approx(spans[0].item.size)


def test_chunks_have_names_of_their_own_that_do_not_change():
    items = [item("a.png"), item("b.png")]
    (one,), (same,) = chunks(items), chunks(items)
    assert one.name == same.name
    others = [
        chunks([item("a.png")]),
        chunks([item("a.png", "b"), item("b.png", "b")]),
        chunks([item("a.png", modified_s=0.0), item("b.png")]),
        chunks(items, done_by([Span(item("a.png"), 0, 1).done(1)])),
    ]
    assert len({one.name, *(other[0].name for other in others)}) == 5


def test_instruments_without_settings_are_counted_and_the_rest_is_done():
    asked = []

    def settings_of(name):
        asked.append(name)
        if name != "a":
            raise MissingSystemError(f"no system for {name}")
        return SETTINGS

    planner = Planner(settings_of, DoneFrames())
    (chunk,) = planner.chunks([item("1", "b"), item("2", "a"), item("3", "b"), item("4", "a")])
    assert names(chunk) == ["2", "4"]
    assert planner.refused == {"b": ("no system for b.", 2)}
    assert asked == ["b", "a"]


# ------------------------------------------------------------------------ what is done


def test_what_is_done_is_not_planned_again():
    first = [item(f"{k}.png") for k in range(5)]
    done = done_by(span.done(1) for chunk in chunks(first) for span in chunk.spans)
    planner = Planner(lambda name: SETTINGS, done)
    (chunk,) = planner.chunks([*first, item("new.png")])
    assert names(chunk) == ["new.png"]
    assert planner.unchanged == 5


def test_a_file_that_grew_is_gone_on_with():
    before, after = item("a.h5", size=100), item("a.h5", size=200)
    planner = Planner(lambda name: SETTINGS, done_by([Span(before).done(7)]))
    ((span,),) = (chunk.spans for chunk in planner.chunks([after]))
    assert (span.start, span.stop) == (7, None)
    assert (planner.n_changed, planner.changed) == (1, ["a.h5"])


def test_gaps_between_pieces_of_a_stack_are_filled():
    stack = item("a.h5")
    done = done_by([Span(stack, 0, 10).done(10), Span(stack, 20, None).done(5)])
    assert done.left(stack) == ([(10, 20)], False)
    done = done_by([Span(stack, 10, 20).done(10)])
    assert done.left(stack) == ([(0, 10), (20, None)], False)


def test_what_is_left_agrees_with_sets_of_frames(rng):
    for _ in range(100):
        n = int(rng.integers(1, 30))
        edges = np.unique([0, *rng.integers(0, n + 1, 4), n])
        pieces = [
            Span(item("a"), int(start), None if stop == n else int(stop))
            for start, stop in zip(edges[:-1], edges[1:], strict=True)
        ]
        kept = [piece for piece in pieces if rng.random() < 0.5]
        done = done_by([piece.done(n - piece.start) for piece in kept])
        done.add([Span(item("other")).done(3)])
        left = {
            frame
            for start, stop in done.left(item("a"))[0]
            for frame in range(start, n if stop is None else stop)
        }
        have = {f for p in kept for f in range(p.start, n if p.stop is None else p.stop)}
        assert left == set(range(n)) - have


def test_many_names_are_told_apart():
    done = done_by(Span(item(f"{k}.png")).done(1) for k in range(3000))
    assert len(done) == 3000
    assert all(not done.left(item(f"{k}.png"))[0] for k in range(3000))
    assert all(done.left(item(f"{k}.tif"))[0] == [(0, None)] for k in range(3000))


def test_spans_survive_as_text():
    spans = [
        DoneSpan("/a/b\udcff.png", 123, 1.7e9, 0, 1, True),
        DoneSpan("c.h5:/frames", 0, None, 50, 100, False),
    ]
    text = pack_spans(spans)
    assert unpack_spans(text) == spans
    for damaged in (text[:-4], "", "x" + text[1:], text[:8] + "AAAA" + text[12:]):
        with pytest.raises(ValueError):
            unpack_spans(damaged)


def test_a_thousand_spans_take_few_bytes():
    spans = [Span(item(f"/data/archive/ch0001/image{k:06d}.png")).done(1) for k in range(1000)]
    assert len(pack_spans(spans)) < 20_000
