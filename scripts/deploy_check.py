"""Checks the Kubernetes manifests against the published schemas, strictly, and prints one line per manifest and one
for what each container runs.

    python scripts/deploy_check.py deploy/kubernetes/base deploy/kubernetes/gpu

Each folder is a kustomization; resources of folders that it builds on are read, too, and its patches are merged into
them as Kubernetes merges: lists of named things by name, other lists as a whole; then it changes names and tags of
images. Beyond the schemas, each of its images must be one of a container, each variable in a command one of its
container, each port of a network policy one of the pods that it is for, and whom it lets in a pod, too. What does not
fit is named on stderr, with exit status 1. Needs kubernetes-validate, which brings the schemas along, and PyYAML.
"""

import pathlib
import re
import sys

import kubernetes_validate
import yaml

# The oldest in which what we use is stable, and the newest that is published.
VERSIONS = ["1.34", "1.37"]


def documents(path):
    return [document for document in yaml.safe_load_all(path.read_text()) if document]


def merged(old, new):
    if isinstance(old, dict) and isinstance(new, dict):
        return old | {key: merged(old[key], value) if key in old else value for key, value in new.items()}
    named = lambda items: all(isinstance(item, dict) and "name" in item for item in items)
    if isinstance(old, list) and isinstance(new, list) and named(old) and named(new):
        by_name = {item["name"]: item for item in old}
        for item in new:
            by_name[item["name"]] = merged(by_name.get(item["name"], {}), item)
        return list(by_name.values())
    return new


def name(document):
    return document["kind"], document["metadata"]["name"]


def build(folder):
    """The documents of a kustomization by kind and name, and its images that no container has."""
    (kustomization,) = documents(folder / "kustomization.yaml")
    built, loose = {}, []
    for resource in kustomization["resources"]:
        path = folder / resource
        if path.is_dir():
            more, of_base = build(path)
            loose += of_base
        else:
            more = {name(document): document for document in documents(path)}
        if both := built.keys() & more.keys():
            raise ValueError(f"{folder}: more than one {both}")
        built |= more
    for patch in kustomization.get("patches", []):
        for document in documents(folder / patch["path"]):
            built[name(document)] = merged(built[name(document)], document)
    for change in kustomization.get("images", []):
        chosen = [container for _, container in containers(built) if image(container)[0] == change["name"]]
        for container in chosen:
            is_now, tag = image(container)
            container["image"] = f"{change.get('newName', is_now)}:{change.get('newTag', tag)}"
        if not chosen:
            loose.append(f"no container has the image {change['name']}")
    return built, loose


def pods(built):
    """What pods are made from, by kind and name."""
    return {key: document["spec"]["template"] for key, document in built.items() if "template" in document.get("spec", {})}


def containers(built):
    """Each container, with kind and name of what it is of."""
    return [(key, container) for key, pod in pods(built).items() for container in pod["spec"]["containers"]]


def image(container):
    """Name and tag; a registry may have a port."""
    name, tag = re.fullmatch(r"(.+?)(?::([^:/]+))?", container["image"]).groups()
    return name, tag or "latest"


def command(container):
    return [*container.get("command", []), *container.get("args", [])]


def variables(container, built):
    for variable in container.get("env", []):
        yield variable["name"]
    for source in container.get("envFrom", []):
        yield from built.get(("ConfigMap", source.get("configMapRef", {}).get("name")), {}).get("data", {})


def chosen(selector, built):
    """The keys of the pods that a selector by labels chooses."""
    labels = selector["podSelector"]["matchLabels"].items()
    return [key for key, pod in pods(built).items() if labels <= pod["metadata"]["labels"].items()]


def loose_ends(built):
    """What one manifest refers to and no manifest has; Kubernetes takes such a one as it is."""
    for (kind, of), container in containers(built):
        has = set(variables(container, built))
        for name in re.findall(r"\$\((\w+)\)", " ".join(command(container))):
            if name not in has:
                yield f"{kind} {of}: no variable {name} for $({name})"
    for (kind, of), policy in built.items():
        if kind != "NetworkPolicy":
            continue
        guarded = chosen(policy["spec"], built)
        ports = [port for key, container in containers(built) if key in guarded for port in container.get("ports", [])]
        has = {port["containerPort"] for port in ports}
        for rule in policy["spec"]["ingress"]:
            for port in rule["ports"]:
                if port["port"] not in has:
                    yield f"{kind} {of}: none of its pods has port {port['port']}"
            for source in rule["from"]:
                if not chosen(source, built):
                    yield f"{kind} {of}: lets in no pod, but {source['podSelector']['matchLabels']}"


def main():
    failed = False
    for folder in map(pathlib.Path, sys.argv[1:]):
        built, images = build(folder)
        for (kind, of), container in containers(built):
            print(f"{folder.name}: {kind} {of} runs {container['image']}: {' '.join(command(container))}")
        for loose in [*images, *loose_ends(built)]:
            failed = True
            print(f"{folder.name}: {loose}", file=sys.stderr)
        for (kind, of), document in built.items():
            for version in VERSIONS:
                try:
                    kubernetes_validate.validate(document, version, strict=True)
                    print(f"{folder.name}: {kind} {of} is valid in {version}")
                except kubernetes_validate.ValidationError as error:
                    failed = True
                    where = ".".join(map(str, error.path))
                    print(f"{folder.name}: {kind} {of}, {where}: {error.message}", file=sys.stderr)
    sys.exit(failed)


if __name__ == "__main__":
    main()
