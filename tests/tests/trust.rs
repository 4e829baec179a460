//! Who is let in, and on whose word: tokens and TLS between real processes.

use std::time::Duration;

use planesweep_tests::{Authority, Bench, Cluster, Running, plane, run, wait_until};

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);
/// The test double computes at once.
const ANALYTIC: [&str; 2] = ["--device", "analytic"];
/// The exit code of a worker that should not be started again.
const REFUSED: i32 = 78;

fn of_plane() -> Bench {
    Bench::new(|folder| drop(plane(folder, 4)))
}

#[test]
fn tls_gives_the_same_cloud_and_lets_in_only_who_speaks_it_and_trusts_it() {
    let bench = of_plane();
    let _ = bench.reconstruct("alone", &[&ANALYTIC[..], &["--workers", "1"]].concat()).expect_code(0);
    let (authority, stranger) =
        (Authority::new(&bench.path(""), "ours"), Authority::new(&bench.path(""), "other"));
    let (ca, other_ca) = (authority.file(), stranger.file());
    let trusting = ["--tls-ca", &*ca];
    let (server, maps) = (authority.certificate("server", 4000), authority.certificate("worker", 4000));
    let cluster = Cluster::start(&bench, &server.options());
    assert!(cluster.url().starts_with("https://"), "{}", cluster.url());
    // The one that fuses has the maps from the one that infers, over TLS, too.
    let worker = [&ANALYTIC[..], &trusting, &maps.options(), &["--no-shared-memory", "--role"]].concat();
    let workers = ["infer", "fuse"].map(|role| cluster.worker(&[&worker[..], &[role]].concat()));
    let submit = [&ANALYTIC[..], &trusting].concat();
    let done = bench.submit("secure", &cluster, &submit).wait().expect_code(0);
    assert_eq!(done.json()["skipped"], serde_json::json!([]));
    bench.same_cloud("alone", "secure");
    let maps = &done.json()["report"]["maps_by_way"];
    assert!(maps["by stream"].as_u64() > Some(0), "no map came over TLS: {maps}");
    assert_eq!(cluster.status("scene-1", &trusting)["refused_callers"], 0);

    // Nobody of the system vouches for it, nor does the other authority.
    for more in [&[][..], &["--tls-ca", &other_ca]] {
        let refused = bench.submit("none", &cluster, &[&ANALYTIC[..], more].concat()).wait().expect_code(1);
        assert!(refused.stderr.contains("unauthenticated"), "{}", refused.stderr);
        assert!(refused.stderr.contains("--tls-ca"), "{}", refused.stderr);
    }
    let refused = cluster.worker(&["--tls-ca", &other_ca]).wait().expect_code(REFUSED);
    assert!(refused.stderr.contains("--tls-ca"), "{}", refused.stderr);

    let plain_url = cluster.url().replace("https://", "http://");
    let plain = run(["status", "--coordinator", &plain_url]).expect_code(1);
    assert!(plain.stderr.contains("begins with https://"), "{}", plain.stderr);
    let plain = run(["worker", "--coordinator", &plain_url, "--device", "analytic"]).expect_code(REFUSED);
    assert!(plain.stderr.contains("begins with https://"), "{}", plain.stderr);
    let pointless = run(["status", "--coordinator", &plain_url, "--tls-ca", &ca]).expect_code(1);
    assert!(pointless.stderr.contains("write https://"), "{}", pointless.stderr);
    // Two clients and a worker that do not trust it, a client and a worker that speak no TLS.
    let refused_callers = || cluster.status("scene-1", &trusting)["refused_callers"].as_u64();
    assert!(wait_until(DEADLINE, || refused_callers() >= Some(5)), "{:?}", refused_callers());
    let said = cluster.coordinator_stderr();
    assert!(said.contains("does not speak TLS") && said.contains("a handshake failed"), "{said}");
    drop(workers);
}

#[test]
fn an_expired_certificate_is_refused_by_clients_and_workers() {
    let bench = of_plane();
    let authority = Authority::new(&bench.path(""), "ours");
    let ca = authority.file();
    let cluster = Cluster::start(&bench, &authority.certificate("expired", 2001).options());
    let more = [&ANALYTIC[..], &["--tls-ca", &ca]].concat();
    let ended: [Running; 2] = [bench.submit("out", &cluster, &more), cluster.worker(&more)];
    for (process, code) in ended.into_iter().zip([1, REFUSED]) {
        let refused = process.wait().expect_code(code);
        assert!(refused.stderr.contains("unauthenticated"), "{}", refused.stderr);
        assert!(refused.stderr.contains("expired; it must be renewed"), "{}", refused.stderr);
    }
}

#[test]
fn certificates_that_are_none_are_refused_and_maps_do_not_leave_the_host_in_plain_text() {
    let bench = of_plane();
    let authority = Authority::new(&bench.path(""), "ours");
    let (good, ca) = (authority.certificate("server", 4000), authority.file());
    let other = authority.certificate("another", 4000);
    let (ledger, store) = (bench.path("ledger.sqlite"), bench.path("store"));
    let coordinator = |cert: &str, key: &str| {
        let given = ["coordinator", "--listen", "127.0.0.1:0", "--ledger", &ledger, "--store", &store];
        run(given.iter().chain(&["--tls-cert", cert, "--tls-key", key])).expect_code(1).stderr
    };
    let none = bench.path("scene/pair.txt");
    for (cert, key, said) in [
        (&none, &good.key, "no certificate"),
        (&good.cert, &none, "no private key"),
        (&good.cert, &other.key, "cannot be used"),
        (&bench.path("missing"), &good.key, "missing"),
    ] {
        let stderr = coordinator(cert, key);
        assert!(stderr.contains(said), "{said}: {stderr}");
    }

    let token = bench.path("token");
    std::fs::write(&token, "s3cret").expect("written");
    let open = ["worker", "--coordinator", "https://127.0.0.1:1", "--listen", "0.0.0.0:0", "--tls-ca", &ca];
    let refused = run(open.iter().chain(&["--token-file", &token])).expect_code(REFUSED);
    assert!(refused.stderr.contains("over TLS only"), "{}", refused.stderr);
    // An address that is taken may be free elsewhere.
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let taken = listener.local_addr().expect("it is bound").to_string();
    let refused = run(["worker", "--coordinator", "http://127.0.0.1:1", "--listen", &taken]).expect_code(1);
    assert!(refused.stderr.contains("could not listen"), "{}", refused.stderr);
}

#[test]
fn callers_without_the_token_are_refused_and_counted() {
    let bench = of_plane();
    let (ledger, store) = (bench.path("ledger.sqlite"), bench.path("store"));
    let open = ["coordinator", "--listen", "0.0.0.0:0", "--ledger", &ledger, "--store", &store];
    let refused = run(open).expect_code(1);
    assert!(refused.stderr.contains("a token is needed"), "{}", refused.stderr);
    let open = ["worker", "--coordinator", "http://127.0.0.1:1", "--listen", "0.0.0.0:0"];
    let refused = run(open).expect_code(REFUSED);
    assert!(refused.stderr.contains("only with a token"), "{}", refused.stderr);

    let (token, wrong) = (bench.path("token"), bench.path("wrong"));
    std::fs::write(&token, "s3cret\n").expect("written");
    std::fs::write(&wrong, "secret\n").expect("written");
    let cluster = Cluster::start(&bench, &["--token-file", &token]);
    let right = [&ANALYTIC[..], &["--token-file", &token]].concat();
    let _worker = cluster.worker(&right);
    for (more, said) in [
        (&[][..], "name its file with --token-file"),
        (&["--token-file", &wrong][..], "must be the coordinator's"),
    ] {
        let refused = bench.submit("out", &cluster, &[&ANALYTIC[..], more].concat()).wait().expect_code(1);
        assert!(refused.stderr.contains("unauthenticated"), "{}", refused.stderr);
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
        let refused = cluster.worker(more).wait().expect_code(REFUSED);
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
    }
    let _ = bench.submit("out", &cluster, &right).wait().expect_code(0);
    let counted = cluster.status("scene-1", &["--token-file", &token]);
    assert_eq!(counted["refused_callers"], 4, "{counted}");
    let shown = run(["status", "scene-1", "--coordinator", cluster.url(), "--token-file", &token]);
    assert!(shown.expect_code(0).stdout.contains("4 callers were refused"));
}
