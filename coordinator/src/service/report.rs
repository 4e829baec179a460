//! `Report`.

use planesweep_proto::{Report, ServiceError, wire};

use super::{Service, check_protocol, check_versions};
use crate::driver::Message;

impl Service {
    pub(super) async fn answer_report(
        &self,
        request: wire::ReportRequest,
    ) -> Result<wire::ReportReply, ServiceError> {
        check_protocol(request.protocol_version)?;
        let report = Report::try_from(request)?;
        let caller = format!("worker {}", report.worker);
        check_versions(&caller, &report.code_version, report.numerics_version)?;
        let answer = self.driver.ask(|reply| Message::Report(report, reply)).await??;
        Ok((&answer).into())
    }
}
