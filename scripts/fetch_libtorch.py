"""Fetches the wheels that hold libtorch 2.13.0 and unpacks the libraries and headers of its CPU part.

Called by fetch-libtorch.sh with the folder to fill; with --check before it, says by its exit status
whether that folder is complete. Only the standard library is used; pip is asked where the wheels lie,
the download itself is resumable.
"""

import fcntl
import hashlib
import http.client
import json
import pathlib
import shutil
import subprocess
import sys
import time
import urllib.request
import zipfile

# requirement, sha256 of the wheel, members to unpack: (prefix in the wheel, prefix in the folder)
WHEELS = [
    (
        "torch==2.13.0",
        "60fcdcb2f3876e21146cb4524ef06397d727ca9ad5f020818547e25075fe3cb7",
        [
            ("torch/lib/libc10.so", "lib/libc10.so"),
            ("torch/lib/libtorch_cpu.so", "lib/libtorch_cpu.so"),
            ("torch/lib/libtorch.so", "lib/libtorch.so"),
            ("torch/lib/libgomp.so.1", "lib/libgomp.so.1"),
            ("torch/include/", "include/"),
        ],
    ),
    (
        "nvidia-cuda-runtime==13.0.96",
        "7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548",
        [("nvidia/cu13/lib/libcudart.so.13", "lib/libcudart.so.13")],
    ),
    (
        "nvidia-cuda-cupti==13.0.85",
        "4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8",
        [("nvidia/cu13/lib/libcupti.so.13", "lib/libcupti.so.13")],
    ),
]
PLATFORMS = ["manylinux_2_28_x86_64", "manylinux_2_25_x86_64", "manylinux_2_17_x86_64"]
CHUNK_BYTES = 1 << 20
TIMEOUT_S = 60


def locate(requirement):
    """Asks pip for the address of the wheel; pip knows the user's mirrors and certificates."""
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--no-deps"]
    command += ["--ignore-installed", "--report", "-", "--target", "unused", "--only-binary=:all:"]
    command += ["--python-version", "3.11", "--implementation", "cp"]
    for platform in PLATFORMS:
        command += ["--platform", platform]
    done = subprocess.run(command + [requirement], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"libtorch: pip cannot find {requirement} (pip 22.2 or newer and a network are needed)")
    return json.loads(done.stdout)["install"][0]["download_info"]["url"]


def sha256(path):
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def download(url, path):
    """Appends what is still missing of `url` to `path`. When this returns, `path` has the full length.

    Raises OSError when the connection or the disk fails; what has arrived stays, to be resumed.
    """
    have = path.stat().st_size if path.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
        if have and answer.status != 206:
            have = 0
        total = have + int(answer.headers.get("Content-Length", 0))
        shown = 0.0
        with open(path, "ab" if have else "wb") as file:
            while chunk := answer.read(CHUNK_BYTES):
                file.write(chunk)
                have += len(chunk)
                if time.monotonic() - shown > 1.0 or have == total:
                    shown = time.monotonic()
                    print(f"libtorch: {path.name} {have >> 20} of {total >> 20} MiB", file=sys.stderr)
    # A connection that breaks ends read() as the end of the file does.
    if have < total:
        raise ConnectionError(f"the connection ended after {have} of {total} bytes")


def fetch(requirement, digest, folder):
    name = requirement.split("==")[0]
    path = folder / f"{name}.whl.part"
    for attempt in range(5):
        if path.exists() and sha256(path) == digest:
            return path
        try:
            download(locate(requirement), path)
        except (OSError, http.client.HTTPException) as error:
            if getattr(error, "code", None) != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
                print(f"libtorch: {name}: {error}; trying again", file=sys.stderr)
                time.sleep(2**attempt)
                continue
            # Nothing is missing: the full length is there.
        if sha256(path) == digest:
            return path
        print(f"libtorch: {name}: sha256 differs, starting over", file=sys.stderr)
        path.unlink()
    sys.exit(f"libtorch: could not download {requirement}; run this again to resume")


def unpack(wheel, members, folder):
    with zipfile.ZipFile(wheel) as archive:
        for source, target in members:
            is_folder = source.endswith("/")
            names = [
                name
                for name in archive.namelist()
                if not name.endswith("/") and (name.startswith(source) if is_folder else name == source)
            ]
            if not names:
                sys.exit(f"libtorch: {wheel.name} holds no {source}")
            for name in names:
                out = folder / (target + name[len(source):])
                out.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(name) as reader, open(out, "wb") as writer:
                    shutil.copyfileobj(reader, writer, CHUNK_BYTES)


# Written last, it names what was unpacked: complete or absent.
STAMP = "planesweep-complete"
STAMPED = "\n".join(digest for _, digest, _ in WHEELS)


def is_complete(cache):
    stamp = cache / STAMP
    return stamp.exists() and stamp.read_text() == STAMPED


def main():
    cache = pathlib.Path(sys.argv[-1])
    if sys.argv[1] == "--check":
        sys.exit(not is_complete(cache))
    cache.parent.mkdir(parents=True, exist_ok=True)
    with open(cache.with_name(cache.name + ".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        # Another process may have filled it meanwhile.
        if is_complete(cache):
            return
        downloads = cache.with_name(cache.name + ".download")
        downloads.mkdir(exist_ok=True)
        fresh = cache.with_name(cache.name + ".new")
        shutil.rmtree(fresh, ignore_errors=True)
        for requirement, digest, members in WHEELS:
            unpack(fetch(requirement, digest, downloads), members, fresh)
        (fresh / STAMP).write_text(STAMPED)
        shutil.rmtree(cache, ignore_errors=True)
        fresh.rename(cache)
        shutil.rmtree(downloads)
    print(f"libtorch: ready in {cache}", file=sys.stderr)


if __name__ == "__main__":
    main()
