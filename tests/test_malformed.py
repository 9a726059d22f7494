"""Files and options of others: refused in words, or sound; never a raw error, never accepted in silence."""

import warnings

import pytest
from fault_counts import count
from hypothesis import HealthCheck, given, settings
from malformed_files import GOOD, READERS, damaged, outcome
from malformed_options import cases
from malformed_options import outcome as option_outcome

FEW, MANY = 5, 150
SHARED = {"derandomize": True, "deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}


def require_words_or_soundness(name, folder, examples):
    found = outcome(name, GOOD[name], folder)
    assert found == "sound"

    @settings(max_examples=examples, **SHARED)
    @given(file=damaged(name))
    def tried(file):
        found = outcome(name, file, folder)
        count(f"malformed files: {name}", found.split(":")[0], defect=found not in ("refused", "sound"))
        assert found in ("refused", "sound")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        tried()


@pytest.mark.usefixtures("unchecked")  # what stands for an algorithm is none
@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_refused_or_sound(name, tmp_path):
    require_words_or_soundness(name, tmp_path, FEW)


@pytest.mark.faults
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_files_are_refused_or_sound(name, tmp_path):
    require_words_or_soundness(name, tmp_path, MANY)


def require_no_defects(every):
    defects = []
    for case, kind in list(cases())[::every]:
        found = option_outcome(case, kind)
        defect = found not in ("refused", "accepted")
        count("constructor and option inputs", found.split(":")[0], defect=defect)
        defects += [f"{case!r}: {found}"] if defect else []
    assert not defects


@pytest.mark.usefixtures("unchecked")
def test_a_wrong_option_is_refused_by_its_name():
    require_no_defects(every=40)


@pytest.mark.faults
@pytest.mark.usefixtures("unchecked")
def test_every_wrong_option_is_refused_by_its_name():
    require_no_defects(every=1)


@pytest.mark.parametrize("compressed", [True, False], ids=["compressed", "overlapping"])
def test_a_file_of_tensors_that_would_grow_is_refused(tmp_path, compressed):
    import zipfile

    path = tmp_path / "weights.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 100_000)
    if not compressed:
        whole = path.read_bytes()
        size = (100_000).to_bytes(4, "little")
        path.write_bytes(whole.replace(size, (2**31).to_bytes(4, "little")))
    with pytest.raises(ValueError, match=r"weights\.pt is damaged, or no file of a run"):
        READERS["weights.pt"].read(path)
