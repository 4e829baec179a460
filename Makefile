# One entry point. `make help` lists the targets.

CARGO ?= cargo
PROGRAM := target/release/planesweep

.PHONY: help libtorch build release test slow check demo clean

help: ## list the targets
	@awk -F':.*## ' '/^[a-z]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' Makefile

libtorch: ## fetch libtorch into the user's cache folder (nothing to do when LIBTORCH is set)
	@scripts/fetch-libtorch.sh

build: libtorch ## build everything as the tests use it
	$(CARGO) build --workspace

release: libtorch ## build target/release/planesweep
	$(CARGO) build --release -p planesweep

test: libtorch ## run all tests; what was skipped is counted and named
	@scripts/test.sh

slow: libtorch ## run the tests that take too long for every run; scripts/slow.sh names them
	@scripts/slow.sh

check: libtorch ## formatting, lints, documentation, licences
	$(CARGO) fmt --all --check
	$(CARGO) clippy --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --workspace --no-deps --quiet
	@if command -v cargo-deny >/dev/null; then cargo deny --log-level error check; \
	else echo "cargo-deny is not installed, so licences were not checked: cargo install --locked cargo-deny"; fi

demo: release ## make a scene, reconstruct it, compare with its exact depth (WEIGHTS=FILE: with others than our own)
	@scripts/demo.sh $(PROGRAM) "$(WEIGHTS)"

clean: ## remove what was built, not the cached libtorch
	rm -rf target demo
