//! A PostgreSQL server of a test's own.

use std::fs::{self, File};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use tempfile::TempDir;

/// How long the server may take to start; installing it may be part of that.
const READY: Duration = Duration::from_mins(5);
/// What scripts/postgres.sh exits with where there is no PostgreSQL.
const NONE_HERE: i32 = 77;

/// A server with an empty database. Dropped, it is killed.
pub struct Postgres {
    folder: TempDir,
    port: u16,
    server: Option<Child>,
}

impl Postgres {
    /// Starts one; where that cannot be, says that `test` is skipped.
    pub fn start(test: &str) -> Option<Self> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        // The server runs as another user.
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).expect("a folder of ours");
        let free = TcpListener::bind(("127.0.0.1", 0)).expect("a free port");
        let port = free.local_addr().expect("it is bound").port();
        drop(free);
        let mut postgres = Self { folder, port, server: None };
        if postgres.come_back() {
            return Some(postgres);
        }
        eprintln!("SKIPPED {test}: no PostgreSQL is installed and none can be");
        None
    }

    /// Its address.
    pub fn url(&self) -> String {
        format!("postgres://planesweep@127.0.0.1:{}/postgres", self.port)
    }

    /// Ends it at once, as a crash would.
    pub fn go_away(&mut self) {
        let Some(mut server) = self.server.take() else { return };
        let killed = Command::new("kill").args(["-QUIT", &server.id().to_string()]).status();
        assert!(killed.is_ok_and(|status| status.success()), "the server cannot be killed");
        server.wait().expect("it has ended");
    }

    /// Starts it again, on the same data and port; `false` where there is no PostgreSQL.
    pub fn come_back(&mut self) -> bool {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scripts/postgres.sh");
        let log = self.folder.path().join("log");
        let mut server = Command::new(script)
            .arg(self.folder.path())
            .arg(self.port.to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(File::create(&log).expect("a file"))
            .spawn()
            .expect("the script starts");
        let begun = Instant::now();
        loop {
            let said = fs::read_to_string(&log).unwrap_or_default();
            if said.contains("database system is ready to accept connections") {
                self.server = Some(server);
                return true;
            }
            if let Some(ended) = server.try_wait().expect("a child can be asked") {
                assert!(ended.code() == Some(NONE_HERE), "no server ({ended}): {said}");
                return false;
            }
            assert!(begun.elapsed() < READY, "the server does not start: {said}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        self.go_away();
    }
}
