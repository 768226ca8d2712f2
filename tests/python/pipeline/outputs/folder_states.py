"""The files in a folder, with what they hold."""


def state_of(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes().decode("latin-1")
        for path in folder.rglob("*")
        if path.is_file() and ".writing-" not in str(path)
    }
