"""Public names of the package; ruff's rules about private names and imports are in tests/ruff.toml."""

import lavender as lv


def test_dir_of_the_package_lists_public_names_that_exist():
    assert dir(lv) == sorted(lv.__all__)
    assert not {"Any", "TYPE_CHECKING", "import_module"} & set(dir(lv))
    for name in dir(lv):
        getattr(lv, name)
