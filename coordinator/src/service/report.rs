//! `Report`.

use planesweep_plan::NUMERICS_VERSION;
use planesweep_proto::{CODE_VERSION, Code, Report, ServiceError, wire};

use super::{Service, check_protocol};
use crate::driver::Message;

impl Service {
    pub(super) async fn answer_report(
        &self,
        request: wire::ReportRequest,
    ) -> Result<wire::ReportReply, ServiceError> {
        check_protocol(request.protocol_version)?;
        let report = Report::try_from(request)?;
        check_code(&report)?;
        let answer = self.driver.ask(|reply| Message::Report(report, reply)).await??;
        Ok((&answer).into())
    }
}

/// Results of another version must not mix with ours.
fn check_code(report: &Report) -> Result<(), ServiceError> {
    if report.code_version == CODE_VERSION && report.numerics_version == NUMERICS_VERSION {
        return Ok(());
    }
    let text = format!(
        "worker {} is version {} (numerics {}), the coordinator {CODE_VERSION} (numerics {NUMERICS_VERSION})",
        report.worker, report.code_version, report.numerics_version
    );
    Err(ServiceError::new(Code::VersionMismatch, text))
}
