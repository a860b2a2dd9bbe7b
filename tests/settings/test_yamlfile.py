import pytest

from sasmap.errors import InputError
from sasmap.settings.yamlfile import dump_yaml, load_yaml


def load(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text, encoding="utf-8")
    return load_yaml(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("12:30", "12:30"),
        ("010", 10),
        ("no", "no"),
        ("true", True),
        ("2024-01-02", "2024-01-02"),
        ("~", None),
        (".inf", float("inf")),
        ("-2.5", -2.5),
        ("[0.05, 5]", [0.05, 5]),
        ("1_000", "1_000"),
    ],
)
def test_scalars_are_what_they_look_like(tmp_path, text, value):
    assert load(tmp_path, f"key: {text}\n") == {"key": value}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: 1\na: 2\n", "line 2: key 'a' is given twice"),
        ("a: {b: 1, b: 2}\n", "'b' is given twice"),
        ("a: &x 1\nb: *x\n", "line 2: aliases"),
        ("a: !!python/object:os.system x\n", "tag"),
        ("- 1\n", "expected 'key: value'"),
        ("a: [1\n", "line 2"),
        ("1: 2\n", "expected a text key"),
        ("", "expected 'key: value'"),
    ],
)
def test_refusals_name_file_and_line(tmp_path, text, says):
    with pytest.raises(InputError) as caught:
        load(tmp_path, text)
    (fault,) = caught.value.faults
    assert "a.yaml" in fault
    assert says in fault


def test_alias_bomb_does_not_expand(tmp_path):
    lines = ["a0: &a0 [x, x]"] + [f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 30)]
    with pytest.raises(InputError, match="aliases"):
        load(tmp_path, "\n".join(lines))


def test_binary_and_deep_and_missing_files(tmp_path):
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        load_yaml(tmp_path / "b.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        load_yaml(tmp_path / "none.yaml")
    with pytest.raises(InputError):
        load(tmp_path, "a: " + "[" * 5000)


@pytest.mark.parametrize("text", ["!!int abc", "!!float x", "!!bool foo", "!!timestamp x"])
def test_a_tag_that_does_not_fit_is_one_line(tmp_path, text):
    with pytest.raises(InputError) as caught:
        load(tmp_path, f"seed: {text}\n")
    assert len(caught.value.faults) == 1


@pytest.mark.parametrize(
    "value", ["1e3", "no", "12:30", "007", ".inf", "null", 1e-3, True, [0.05, 5]]
)
def test_what_is_dumped_is_read_back(tmp_path, value):
    path = tmp_path / "a.yaml"
    path.write_text(dump_yaml({"key": value}))
    assert load_yaml(path) == {"key": value}
